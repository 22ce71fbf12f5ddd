"""A robot in another language that publishes no capabilities, but lists what it subscribes to."""

from __future__ import annotations

import json
from typing import Any

import pytest

from pebble import contract as c
from pebble.contract import DRIVE
from pebble.extensions.operator.client.announced import announced
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.transports import Message

BASE = "pebble/robots/stranger"
LIST = ["incoming/drive-values", "incoming/lights-solid"]


def payload(**fields: Any) -> bytes:
    return json.dumps({"t": 1710969600000, **fields}).encode()


@pytest.mark.parametrize("made", [payload(subscribes=LIST), payload(value={"subscribes": LIST})], ids=["bare", "value"])
def test_what_it_subscribes_to_is_what_it_offers(made: bytes) -> None:
    value = announced(BASE, made)
    assert value["drive"] == {"available": True, "controls": True, "topic": f"{BASE}/incoming/drive-values"}
    assert value["lights"] == {"solid": True, "flash": False}
    assert not value["video"]["available"]
    assert "estop" not in value
    assert value["announced"] is True


@pytest.mark.parametrize(
    "made",
    [
        payload(),
        payload(subscribes="incoming/drive-values"),
        payload(subscribes=[1, None, "drive-values", "pebble/robots/other/incoming/drive-values"]),
        payload(subscribes=[*LIST, "x" * 5000]),
        b'{"subscribes": [',
        b'["subscribes"]',
        b'"subscribes" \xff',
    ],
)
def test_all_else_announces_nothing(made: bytes) -> None:
    assert announced(BASE, made) == {}


@pytest.mark.parametrize(("channel", "key"), [(c.ONLINE, "subscribes"), (c.STATUS, "value")])
def test_it_is_driven_until_it_publishes_capabilities(channel: c.Channel, key: str) -> None:
    robot = RobotView(BASE)
    made = payload(**{key: LIST if key == "subscribes" else {"subscribes": LIST}})
    robot.receive(channel, Message(channel.topic(BASE), made), now=1.0, wall=1710969600.0)
    assert robot.drives
    assert robot.topic(DRIVE) == f"{BASE}/incoming/drive-values"
    assert not robot.estop.has_capabilities
    capable = Message(c.CAPABILITIES.topic(BASE), payload(value={"drive": {"available": False}}))
    robot.receive(c.CAPABILITIES, capable, now=1.1, wall=1710969600.1)
    robot.receive(channel, Message(channel.topic(BASE), made), now=1.2, wall=1710969600.2)
    assert not robot.drives
