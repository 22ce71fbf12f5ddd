"""At real brokers: `pebble topic expand`, the page with `web_interface.expand`, and a bridge over a thin link."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from pebble.extensions.fleet.roles import Account
from pebble.extensions.operator.client.connection import put_account_into_topics
from pebble.extensions.operator.client.names import Names
from pebble.extensions.page.server import expand
from pebble.extensions.thin.expander import Expander
from pebble.extensions.thin.packed import joined, packed
from pebble.runtime.connections import local_transport
from pebble.services.mqtt_bridge.service import MqttBridge
from pebble.transports import MqttSettings, QoS, Transport, create
from tests.ext.fleet.brokers import HOST, FleetBroker
from tests.robot.operator import Operator
from tests.services.mqtt_bridge.bridge_rig import BASE as ROVER
from tests.services.mqtt_bridge.bridge_rig import Running, make_config
from tests.support import ROOT, SOON_S, WAIT_S, Broker, Child, free_port, until

BASE = "pebble/robots/goob"
STREAMS = {"touch-sensors": b'{"value": {"a0": 1}}', "wheel-odometry": b'{"value": {"x": 1.50}}'}
TEXT = joined(STREAMS)


@contextmanager
def command(broker: Broker) -> Iterator[None]:
    words = [sys.executable, "-m", "pebble.cli", "topic", "expand", f"mqtt://127.0.0.1:{broker.port}"]
    process = Child(words, env=os.environ | {"PYTHONPATH": str(ROOT)}, stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.terminate()
        process.wait(WAIT_S)


@contextmanager
def page(broker: Broker) -> Iterator[None]:
    loop = asyncio.new_event_loop()
    task = loop.create_task(expand(MqttSettings(host="127.0.0.1", port=broker.port)))
    thread = threading.Thread(target=_run, args=(loop, task))
    thread.start()
    try:
        yield
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join(WAIT_S)


def _run(loop: asyncio.AbstractEventLoop, task: asyncio.Task[None]) -> None:
    with suppress(asyncio.CancelledError):
        loop.run_until_complete(task)


@pytest.mark.parametrize("beside", [command, page])
def test_plain_topics_come_of_groups(broker: Broker, beside: Callable[[Broker], Iterator[None]]) -> None:
    seen: dict[str, bytes] = {}
    robot = create("mqtt", "robot", MqttSettings(host="127.0.0.1", port=broker.port)).open(WAIT_S)
    robot.subscribe(f"{BASE}/#", lambda message: seen.update({message.topic: message.payload}), qos=QoS.DELIVERED)
    wire = b'{"group_hz": 2, "dict_id": 3, "dict": "%s"}' % TEXT.replace(b'"', b'\\"')
    robot.publish(f"{BASE}/outgoing/wire", wire, qos=QoS.DELIVERED, retain=True)
    with beside(broker):  # type: ignore[attr-defined]
        assert until(lambda: f"{BASE}/incoming/expander" in seen)

        def comes() -> bool:
            robot.publish(f"{BASE}/outgoing/group", packed(TEXT, 3, TEXT), qos=QoS.LATEST)
            return until(lambda: all(seen.get(f"{BASE}/outgoing/{metric}") for metric in STREAMS), 1)

        assert until(comes)
    assert {metric: seen[f"{BASE}/outgoing/{metric}"] for metric in STREAMS} == STREAMS
    robot.close()


ACCOUNTS = {"goob": Account(roles=("robot",), bases=(BASE,)), "vera": Account(roles=("viewer",))}


@pytest.mark.parametrize(
    ("level", "roles", "comes"),
    [("login", ("expander",), True), ("named", ("page", "expander"), True), ("named", ("page",), False)],
)
def test_at_a_fleets_broker_it_has_an_account_of_its_own(
    tmp_path: Path, level: Any, roles: tuple[str, ...], comes: bool
) -> None:
    """The robot sends by the name of its account, once that is heard; a viewer sees the plain topics."""
    accounts, said, seen = ACCOUNTS | {"exp": Account(roles=roles)}, list[bytes](), dict[str, bytes]()
    with FleetBroker(tmp_path / "hall", accounts, level=level, unencrypted=free_port()) as hall, ExitStack() as opened:

        def client(name: str) -> Transport:
            port = hall.unencrypted or 0
            settings = MqttSettings(host=HOST, port=port, username=name, password=hall.passwords[name])
            return opened.enter_context(create("mqtt", name, settings))

        robot, vera, exp = map(client, ("goob", "vera", "exp"))
        expander = Expander(exp)
        put_account_into_topics(exp, Names("", None, "exp"), expander.is_named)
        robot.subscribe(f"{BASE}/incoming/#", lambda message: said.append(message.payload), qos=QoS.DELIVERED)
        vera.subscribe(f"{BASE}/outgoing/#", lambda message: seen.update({message.topic: message.payload}))
        wire = b'{"group_hz": 2, "short": "~/goob", "named": %s}' % str(level == "named").lower().encode()
        robot.publish(f"{BASE}/outgoing/wire", wire, qos=QoS.DELIVERED, retain=True)
        expander.start()

        def arrives() -> bool:
            expander.announce()
            robot.publish("~/goob", TEXT, qos=QoS.LATEST)
            return until(
                lambda: f"{BASE}/outgoing/wheel-odometry" in seen and b'"short":"~/goob"' in b"".join(said), 0.3
            )

        assert until(arrives, WAIT_S if comes else 1) is comes
        assert bool(said) is comes, "it is not even said that it is there"


IMU, STOP, ONLINE, LINK = "outgoing/sensors/imu", "incoming/estop", "outgoing/online", "outgoing/link"
FLOOD = 3_000


@pytest.fixture
def brokers(tmp_path: Path) -> Iterator[list[Broker]]:
    brokers = [Broker(tmp_path, "max_queued_messages 0"), Broker(tmp_path)]
    yield brokers
    for broker in brokers:
        broker.stop()


def test_a_stop_passes_at_once_while_much_waits(brokers: list[Broker]) -> None:
    local, remote = brokers
    config = make_config(
        local_mqtt={"host": "127.0.0.1", "port": local.port},
        remote_mqtt={"host": "127.0.0.1", "port": remote.port},
        link={"profile": "thin", "kbit": 9.6},
    )
    running = Running(MqttBridge(config, local_transport(config, "local-bridge", as_published=True)))
    robot, operator = Operator(local.port, ROVER), Operator(remote.port, ROVER)
    assert until(lambda: operator.last(LINK) and len([one for one in operator.seen if one.topic.endswith(ONLINE)]) >= 2)
    for number in range(FLOOD):
        robot.send(IMU, {"n": number})
    began = time.monotonic()
    operator.send(STOP, {"stop": "00000000000000a1", "by": "test"})
    assert until(lambda: robot.last(STOP))
    stopped = robot.last(STOP)
    assert stopped is not None
    assert stopped.at - began < SOON_S
    assert until(lambda: json.loads((operator.last(IMU) or stopped).payload).get("n") == FLOOD - 1)
    arrived = [one for one in operator.seen if one.topic.endswith("imu")]
    assert len(arrived) < FLOOD / 50
    heartbeats = [one.at for one in operator.seen if one.topic.endswith(ONLINE)]
    assert len(heartbeats) <= heartbeats[-1] - heartbeats[0] + 2.5, "one a second"
    operator.close()
    robot.close()
    running.stop()
