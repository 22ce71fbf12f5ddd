"""A bridge over a thin link between real brokers."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from pebble.runtime.connections import local_transport
from pebble.services.mqtt_bridge.service import MqttBridge
from pebble.transports import State
from pebble.transports.hosts import CONNECT_TIMEOUT_S
from tests.robot.operator import Operator
from tests.services.mqtt_bridge import rsa_chain
from tests.services.mqtt_bridge.bridge_rig import BASE, Running, make_config
from tests.support import Broker, cases, until
from tests.tcp_proxy import SlowTcpProxy, TcpProxy

IMU, STOP, ONLINE, LINK = "outgoing/sensors/imu", "incoming/estop", "outgoing/online", "outgoing/link"
DRIVE, OWN = "incoming/drive-values", "emergency stops have a connection of their own"
FLOOD = cases(3_000, 10_000)


@pytest.fixture
def brokers(tmp_path: Path) -> Iterator[list[Broker]]:
    brokers = [Broker(tmp_path, "max_queued_messages 0"), Broker(tmp_path)]
    yield brokers
    for broker in brokers:
        broker.stop()


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["pebble", "paho"])
def test_it_connects_by_tls_to_a_broker_with_two_certificates_of_rsa(tmp_path: Path, kind: str) -> None:
    """Over 9.6 kbit/s and 0.6 s to and fro they take 3 s."""
    chain = rsa_chain.make(tmp_path, "127.0.0.1")
    local = Broker(tmp_path)
    remote = Broker(tmp_path, f"certfile {chain.sent}", f"keyfile {chain.key}", "set_tcp_nodelay true")
    with (
        SlowTcpProxy(remote.port, 9.6, back=True) as down,
        SlowTcpProxy(down.port, 9.6) as up,
        TcpProxy(up.port, delay_s=0.3) as link,
    ):
        config = make_config(
            local_mqtt={"host": "127.0.0.1", "port": local.port},
            remote_mqtt={
                "host": "127.0.0.1",
                "port": link.port,
                "tls": {"enabled": True, "ca_cert": str(chain.root)},
                "client": kind,
            },
            link={"profile": "thin", "kbit": 9.6},
        )
        began = time.monotonic()
        bridge = MqttBridge(config, local_transport(config, "local-bridge", as_published=True))
        running = Running(bridge)
        assert until(lambda: bridge.remote.state is State.CONNECTED, 60)
        assert time.monotonic() - began > 2 * CONNECT_TIMEOUT_S
        assert bridge.remote.counters["connected"] == 1
        running.stop()
    local.stop()
    remote.stop()


def test_a_stop_passes_at_once_while_much_waits(brokers: list[Broker]) -> None:
    local, remote = brokers
    config = make_config(
        local_mqtt={"host": "127.0.0.1", "port": local.port},
        remote_mqtt={"host": "127.0.0.1", "port": remote.port},
        link={"profile": "thin", "kbit": 9.6},
    )
    running = Running(MqttBridge(config, local_transport(config, "local-bridge", as_published=True)))
    robot, operator = Operator(local.port, BASE), Operator(remote.port, BASE)
    assert until(lambda: operator.last(LINK) and len([one for one in operator.seen if one.topic.endswith(ONLINE)]) >= 2)
    state = operator.last(LINK)
    assert state is not None
    assert (state.json["level"], state.json["drive_hz"]) == ("thin", 4)
    for number in range(FLOOD):
        robot.send(IMU, {"n": number})
    began = time.monotonic()
    operator.send(STOP, {"stop": "00000000000000a1", "by": "test"})
    assert until(lambda: robot.last(STOP))
    stopped = robot.last(STOP)
    assert stopped is not None
    assert stopped.at - began < 5.0, "a deadline for a slow machine"
    assert until(lambda: json.loads((operator.last(IMU) or stopped).payload).get("n") == FLOOD - 1, 30)
    arrived = [one for one in operator.seen if one.topic.endswith("imu")]
    assert len(arrived) < FLOOD / 50
    heartbeats = [one.at for one in operator.seen if one.topic.endswith(ONLINE)]
    assert len(heartbeats) <= heartbeats[-1] - heartbeats[0] + 2.5, "one a second"
    operator.close()
    later = Operator(remote.port, BASE, LINK)
    assert until(lambda: later.seen)
    assert later.seen[0].retain
    later.close()
    robot.close()
    running.stop()


def test_commands_that_only_come_late_are_dropped_at_the_broker_and_stops_get_a_connection_of_their_own(
    brokers: list[Broker], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    local, remote = brokers
    link = TcpProxy(remote.port)
    config = make_config(
        local_mqtt={"host": "127.0.0.1", "port": local.port},
        remote_mqtt={"host": "127.0.0.1", "port": link.port},
        link={"profile": "thin"},
    )
    running = Running(MqttBridge(config, local_transport(config, "local-bridge", as_published=True)))
    robot, operator = Operator(local.port, BASE), Operator(remote.port, BASE)
    assert until(lambda: operator.last(LINK))
    link.delay_s = 0.9  # each way

    def floods() -> bool:
        operator.send(DRIVE, {"z": 0.5})
        return any("only late commands come" in message for message in caplog.messages)

    assert OWN not in caplog.messages
    assert until(floods, 30, step=0.1)
    link.delay_s = 0.0
    assert until(lambda: OWN in caplog.messages, 30)
    operator.send(STOP, {"stop": "00000000000000a1", "by": "test"})
    operator.send(DRIVE, {"z": 0})
    assert until(lambda: robot.last(STOP) and robot.last(DRIVE))
    assert len({one.payload for one in robot.seen if one.topic.endswith(STOP)}) == 1
    for one in (robot, operator):
        one.close()
    running.stop()
    link.stop()
