"""A bridge over a thin link between real brokers."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from pebble.runtime.connections import local_transport
from pebble.services.mqtt_bridge.service import MqttBridge
from tests.robot.operator import Operator
from tests.services.mqtt_bridge.bridge_rig import BASE, Running, make_config
from tests.support import SOON_S, Broker, until

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
    robot, operator = Operator(local.port, BASE), Operator(remote.port, BASE)
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
