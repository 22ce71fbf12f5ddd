"""Tests of pages while an attacker publishes large and odd messages."""

from __future__ import annotations

import socket
from collections.abc import Iterable

import pytest

from tests.ext.page.served import Page, Served
from tests.kit import mqtt_bytes
from tests.kit.played_robot import RecordingRobot
from tests.support import Broker, until

METRICS = ("status", "charging-status", "sensors/imu", "wheel-odometry", "logs", "mcu/x/describe", "autonomy-status")
ODD = (
    b"",
    b"{",
    b"\xff\xfe",
    b'{"value":"\xff"}',
    b'{"value":NaN}',
    b'{"t":1e999}',
    b'{"value":"\\ud800"}',
    b'{"value":' + b"[" * 30_000 + b"]" * 30_000 + b"}",
    b"[" * 60_000,
    b'{"value":1,"value":{"value":null}}',
    b'{"__proto__":{"x":1}}',
    b"null",
    b"\x00",
    b'{"value":"\x00"}',
    b"9" * 60_000,
    b'{"t":' + b"9" * 5000 + b"}",
)


def flood(port: int, messages: Iterable[tuple[str, bytes]]) -> None:
    """Publish everything with QoS 0, as fast as the broker takes it."""
    with socket.create_connection(("127.0.0.1", port), 30) as client:
        client.sendall(mqtt_bytes.connect(None, None))
        assert client.recv(4) == b"\x20\x02\x00\x00"
        for topic, payload in messages:
            client.sendall(mqtt_bytes.publish(topic, payload))
        client.sendall(mqtt_bytes.packet(0xC0, b""))
        assert client.recv(2) == b"\xd0\x00", "the broker has taken everything"


def test_large_and_odd_values_keep_no_page_from_driving(
    broker: Broker, served: Served, page: Page, robot: RecordingRobot, caplog: pytest.LogCaptureFixture
) -> None:
    page.send("watch", ref=robot.base)
    sizes = (10, 60_000, 70_000, 1_000_000)
    large = (
        (f"pebble/robots/z{number}/outgoing/{metric}", b'{"value":"' + b"x" * sizes[number % 4] + b'"}')
        for number in range(200)
        for metric in ("status", "capabilities")
    )
    flood(broker.port, large)
    flood(broker.port, ((f"{robot.base}/outgoing/{metric}", payload) for payload in ODD for metric in METRICS))
    robot.publish("status", {"value": {"last": 1}})
    assert until(lambda: page.value(robot.base, "status", "value") == {"last": 1}, 20), "what pages get is no JSON"
    assert until(lambda: page.moves(robot), 15)
    page.send("stop", ref=robot.base)
    assert until(lambda: robot.drives()[-1]["z"] == 0, 3)
    assert not page.closed, page.bye
    assert [record for record in caplog.records if record.exc_info] == []
