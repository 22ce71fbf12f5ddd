"""Discovery of robots by what they publish to a broker."""

from __future__ import annotations

import json
from itertools import chain
from typing import Any

import pytest

from pebble import contract as c
from pebble.contract import CAPABILITIES, DRIVE, ESTOP_STATE, LINK
from pebble.extensions.operator.client.announced import announced
from pebble.extensions.operator.client.discovery import Discovery
from pebble.extensions.operator.client.robot_view import MAX_REMEMBERED, RobotView
from pebble.transports import Message
from tests.support import ROOT

BASE = "pebble/robots/goob"
WALL = 1_760_000_000.0
LIVENESS = json.loads((ROOT / "tests" / "vectors" / "liveness.json").read_text())["rows"]


def publish(discovery: Discovery, metric: str, body: object, *, now: float = 0.0, retain: bool = False) -> None:
    message = Message(f"{BASE}/outgoing/{metric}", json.dumps(body).encode(), retain=retain)
    discovery.receive(message, now, WALL + now)


def link(level: str | None) -> bytes:
    """What a robot publishes of its link; None: it removes that."""
    body = {"level": level, "drive_hz": 4, "rtt_ms": 600, "queue_ms": 0, "t": 1}
    return b"" if level is None else json.dumps(body).encode()


def publish_heartbeats(discovery: Discovery, *times: float) -> RobotView:
    for now in times:
        publish(discovery, "online", {"t": int((WALL + now - 0.01) * 1000)}, now=now)
    return discovery.robots[BASE]


def test_a_retained_heartbeat_is_no_sign_of_life() -> None:
    discovery = Discovery()
    for now in (0.0, 0.25, 0.5):
        publish(discovery, "online", {"t": int((WALL + now) * 1000)}, now=now, retain=True)
    assert discovery.robots[BASE].liveness.received_at is None


def test_a_server_is_no_robot() -> None:
    discovery = Discovery()
    driving = b'{"t": 1, "robots": {}}'
    discovery.receive(Message("pebble/servers/fair-1/outgoing/driving", driving), 0.0, WALL)
    assert discovery.all_robots() == []


@pytest.mark.parametrize("row", LIVENESS.values(), ids=LIVENESS)
def test_what_heartbeats_show(row: dict[str, Any]) -> None:
    robot = RobotView(BASE)
    for level in row.get("link", ()):
        robot.receive(LINK, Message(LINK.topic(BASE), link(level)), 0.0, 0.0)
    liveness = robot.liveness
    for at, late_s in row["heartbeats"]:
        liveness.heartbeat(at, late_s)
    found = [(at, robot.online(at), liveness.latency_s, liveness.average_latency_s) for at, *_ in row["seen"]]
    assert [*chain(*found)] == pytest.approx([*chain(*row["seen"])], abs=1e-6)


def test_strangers_fill_no_memory_and_keep_no_capabilities_out() -> None:
    seen = RobotView(BASE)
    known = Message(f"{BASE}/outgoing/estop/serial", b"1")
    for message in [known, *(Message(f"{BASE}/outgoing/estop/{n}", b"0") for n in range(100))]:
        seen.receive(ESTOP_STATE, message, 0.0, 0.0)
    capabilities, newer = Message(f"{BASE}/outgoing/capabilities", b"2"), Message(known.topic, b"3")
    seen.receive(CAPABILITIES, capabilities, 0.0, 0.0)
    assert len(seen.remembered) == MAX_REMEMBERED + 1
    seen.receive(ESTOP_STATE, newer, 0.0, 0.0)
    assert (seen.remembered[known.topic], seen.remembered[capabilities.topic]) == (newer, capabilities)


def test_topics_of_another_robot_in_capabilities_are_not_used() -> None:
    discovery = Discovery()
    seen = publish_heartbeats(discovery, 0.0, 0.25, 0.5)
    drive, lights = "pebble/robots/another/incoming/drive-values", "pebble/robots/another/incoming/lights-solid"
    value = {"drive": {"available": True, "topic": drive}, "lights": {"solid_topic": lights}}
    publish(
        discovery, "capabilities", {"schema": "pebble-capabilities/v1", "t": 1, "value": value}, now=0.6, retain=True
    )
    assert (seen.topic(c.DRIVE), seen.topic(c.LIGHTS_SOLID), seen.ready(0.6)) == (None, None, False)
    assert seen.estop.drive_topic == f"{BASE}/incoming/drive-values"


@pytest.mark.parametrize(
    ("drive", "drives", "arbitrates"),
    [
        ({}, False, False),
        ({"available": True, "controls": False}, False, False),
        ({"available": True, "controls": True, "arbitrates": True}, True, True),
        ({"available": "yes", "arbitrates": "yes"}, False, False),
    ],
)
def test_only_what_a_robot_offers_is_assumed_of_it(drive: dict[str, object], drives: bool, arbitrates: bool) -> None:
    discovery = Discovery()
    value = {"drive": drive, "transport": {"kind": "zenoh"}}
    publish(discovery, "capabilities", {"schema": "pebble-capabilities/v1", "t": 1, "value": value}, retain=True)
    publish(discovery, "autonomy-status", {"timestamp": 1, "running": True})
    publish(discovery, "charging-level", {"value": 7.4})
    publish(discovery, "capabilities", "nonsense")
    publish(discovery, "autonomy-status", "nonsense")
    seen = publish_heartbeats(discovery, 0.0, 0.25, 0.5).situation(1.9)
    assert (seen.drives, seen.arbitrates, seen.script, seen.online) == (drives, arbitrates, True, True)
    robot = discovery.robots[BASE]
    assert (robot.transport, robot.volts, discovery.traffic[BASE].count) == ("zenoh", 7.4, 8)
    assert (robot.liveness.online(0.9), robot.liveness.online(1.01)) == (True, False)
    assert robot.online(2.1) is False, "people are told after 1.5 s"
    publish(discovery, "online", {"t": int(WALL * 1000), "online": False}, now=0.6)
    assert robot.liveness.online(0.6) is False, "a will"


# -- a robot in another language without capabilities: what it subscribes to is what it offers


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
        payload(subscribes=[1, None, "drive-values", "pebble/robots/other/incoming/drive-values"]),
        payload(subscribes=[*LIST, "x" * 5000]),
        b'{"subscribes": [',
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
