"""Brokers of several makers: what a robot and its operators have of each, whatever it forbids or lacks."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from pebble.extensions.operator.client.connection import Target, connected, subscribed_stop
from pebble.extensions.operator.client.discovery import ALL_OUTGOING, Discovery
from pebble.transports import MqttSettings, QoS
from pebble.transports.mqtt.transport import MqttTransport
from tests.robot.operator import Operator
from tests.robot.rig import BASE, STOP
from tests.robot.rig import Rig as RobotRig
from tests.sparing_broker import SparingBroker
from tests.support import Broker, beside, until
from tests.transports.brokers import MAKERS, ROBOT, Maker

pytestmark = [pytest.mark.alone, pytest.mark.thorough]  # deadlines are checked; make long PART=brokers runs it

STOPPED = {"latched": True, "boot": "b", "count": 1, "recent": [], "by": "ann", "why": "", "since": 1}


@pytest.fixture(scope="module", params=MAKERS)
def maker(request: pytest.FixtureRequest) -> Maker:
    if MAKERS[request.param].missing():
        pytest.skip(f"needs {request.param}: make long PART=brokers")
    return MAKERS[request.param]


@pytest.fixture(scope="module")
def running(maker: Maker, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Broker]:
    broker = maker.make(tmp_path_factory.mktemp("broker"))
    yield broker
    broker.stop()


@pytest.fixture
def broker(running: Broker) -> Broker:
    if not running.running:
        running.start()
    return running


@pytest.fixture
def base(request: pytest.FixtureRequest) -> str:
    return f"pebble/robots/{request.node.originalname.rpartition('_')[2]}"


def test_an_operators_tool_finds_the_states_of_an_idle_robot(maker: Maker, broker: Broker, base: str) -> None:
    """By wildcards; those of one robot also where a broker sends retained messages for exact names only."""
    front = SparingBroker(broker.port, by_name=True)
    drives = {"drive": {"topic": f"{base}/incoming/drive-values"}}
    estop = {"available": True, "owners": ["serial"], "status_topics": [f"{base}/outgoing/estop/serial"]}
    states: dict[str, Any] = {"capabilities": {"t": 1, "value": {**drives, "estop": estop}}}
    states["charging-level"] = {"value": 12.5}
    states["estop/serial"] = STOPPED
    with MqttTransport("robot", MqttSettings(host="127.0.0.1", port=broker.port)) as robot:
        for name, value in states.items():
            robot.publish(f"{base}/outgoing/{name}", json.dumps(value).encode(), qos=QoS.DELIVERED, retain=True)

        discovery = Discovery()
        with connected(Target(url=f"mqtt://127.0.0.1:{broker.port}")) as (tool, _):
            tool.subscribe(ALL_OUTGOING, lambda message: discovery.receive(message, 0.0, 0.0), direct=True)
            assert until(lambda: maker.by_name or (base in discovery.robots and discovery.robots[base].volts))
            assert until(lambda: maker.by_name or discovery.robots[base].latched)
        for port in (broker.port, front.port):
            with connected(Target(url=f"mqtt://127.0.0.1:{port}", robot=base)) as (tool, _):
                one = subscribed_stop(tool, base)
                assert until(lambda: [state.by for state in one.latched.values()] == ["ann"])  # noqa: B023
    front.close()


def test_a_whole_robot_is_driven_and_stopped_although_it_may_not_publish_a_stream(maker: Maker, broker: Broker) -> None:
    uplink = {"host": "127.0.0.1", "port": broker.port, **ROBOT}
    with RobotRig("zenoh", remote=broker, mqtt_bridge={"remote_mqtt": uplink}) as rig:
        assert not maker.closes or until(lambda: "outgoing/touch-sensors" in rig.log.read_text())
        ending = threading.Event()

        def drive() -> None:
            while not ending.wait(0.05):
                rig.operator.send("incoming/drive-values", {"x": 0, "z": 0.5})

        with beside(drive, ending):
            assert until(rig.mcu.moving)
            rig.operator.send("incoming/estop", {"stop": "a", "by": "ann", "why": ""})
            assert until(lambda: not rig.mcu.moving())
            stopped = time.monotonic()
            rig.operator.wait_for("outgoing/online", since=stopped)
        assert {wheels for _, wheels in rig.mcu.drives(stopped)} <= {STOP}
        for name in ("outgoing/capabilities", "outgoing/status", "outgoing/estop/serial"):
            late = Operator(broker.port, BASE, name)
            late.wait_for(name)
            late.close()
        assert not rig.operator.on("outgoing/touch-sensors")
