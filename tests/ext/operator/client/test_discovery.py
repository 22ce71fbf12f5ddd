"""Discovery of robots by what they publish to a broker, and at what pace commands go over their links."""

from __future__ import annotations

import json
import math
from itertools import chain
from typing import Any

import msgspec
import pytest
from msgspec import UNSET

from pebble import contract as c
from pebble.contract import CAPABILITIES, DRIVE, ESTOP_STATE, LINK, ONLINE
from pebble.contract.levels import silent_after
from pebble.contract.payloads import Drive, LinkLevel, LinkState
from pebble.extensions.operator.client.assumed import announced
from pebble.extensions.operator.client.discovery import Discovery
from pebble.extensions.operator.client.estop import COLLECT_S
from pebble.extensions.operator.client.pace_of_link import WIDE, Pace, pace_of
from pebble.extensions.operator.client.robot_view import MAX_REMEMBERED, RobotView
from pebble.extensions.operator.client.stamps import stamp_of
from pebble.transports import Message, QoS
from tests.ext.operator.client.estop_robot import outgoing
from tests.support import ROOT

BASE = "pebble/robots/goob"
WALL = 1_760_000_000.0
LIVENESS = json.loads((ROOT / "tests" / "vectors" / "liveness.json").read_text())["rows"]


def publish(discovery: Discovery, metric: str, body: object, *, now: float = 0.0, retain: bool = False) -> None:
    discovery.receive(outgoing(BASE, metric, body, retain=retain), now, WALL + now)


def link(level: LinkLevel, hz: float, queue_ms: int = 40) -> LinkState:
    return LinkState(level=level, drive_hz=hz, rtt_ms=310, queue_ms=queue_ms, t=1)


def publish_heartbeats(discovery: Discovery) -> RobotView:
    for now in (0.0, 0.25, 0.5):
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
        state = b"" if level is None else msgspec.json.encode(link(level, 4))
        robot.receive(LINK, Message(LINK.topic(BASE), state), 0.0, 0.0)
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
    seen = publish_heartbeats(discovery)
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
    seen = publish_heartbeats(discovery).situation(1.9)
    assert (seen.drives, seen.arbitrates, seen.script, seen.online) == (drives, arbitrates, True, True)
    robot = discovery.robots[BASE]
    assert (robot.transport, robot.volts) == ("zenoh", 7.4)
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


@pytest.mark.parametrize(("channel", "key"), [(ONLINE, "subscribes"), (c.STATUS, "value")])
def test_it_is_driven_until_it_publishes_capabilities(channel: c.Channel, key: str) -> None:
    robot = RobotView(BASE)
    made = payload(**{key: LIST if key == "subscribes" else {"subscribes": LIST}})
    robot.receive(channel, Message(channel.topic(BASE), made), now=1.0, wall=1710969600.0)
    assert robot.drives
    assert robot.topic(DRIVE) == f"{BASE}/incoming/drive-values"
    assert not robot.estop.has_capabilities
    capable = Message(CAPABILITIES.topic(BASE), payload(value={"drive": {"available": False}}))
    robot.receive(CAPABILITIES, capable, now=1.1, wall=1710969600.1)
    robot.receive(channel, Message(channel.topic(BASE), made), now=1.2, wall=1710969600.2)
    assert not robot.drives


# -- the pace of a link


MOVE = Drive(z=0.5, valid_ms=400)


@pytest.mark.parametrize(
    ("state", "step_s", "qos", "valid_ms"),
    [
        (None, 0.015, QoS.DELIVERED, 400),
        (link("narrow", 10), 0.075, QoS.LATEST, 400),
        (link("thin", 4), 0.225, QoS.LATEST, 750),
        # What a robot reports neither halts it between two commands, nor fills its link.
        (link("narrow", 0), 0.175, QoS.LATEST, 400),
        (link("thin", -7), 0.35, QoS.LATEST, 750),
        (link("thin", 1e9), 0.025, QoS.LATEST, 750),
        # Behind a queue that stays nothing comes in time.
        (link("thin", 2.5, 500), 0.35, QoS.LATEST, 750),
        (link("thin", 2.67, 60_000), 2.0, QoS.LATEST, 750),
        (link("thin", 4, 1700), 0.225, QoS.LATEST, 750),  # it may have been a loss
    ],
)
def test_a_robot_asks_for_a_pace(state: LinkState | None, step_s: float, qos: QoS, valid_ms: int) -> None:
    pace = pace_of(state)
    assert pace._replace(step_s=round(pace.step_s, 6))[:3] == (step_s, qos, valid_ms)
    assert pace.stamped is (qos is QoS.LATEST)


@pytest.mark.parametrize(
    ("pace", "drive", "expected"),
    [
        (WIDE, MOVE, {}),
        (Pace(stamped=True), MOVE, {"t": 12_346, "key": "0badf00d"}),
        (Pace(stamped=True), msgspec.structs.replace(MOVE, key="aa bb"), {"t": 12_346, "key": "aa bb"}),
    ],
)
def test_a_stamped_command_has_a_time_and_a_key(pace: Pace, drive: Drive, expected: dict[str, object]) -> None:
    dated = pace.dated(drive, 12.3456, "0badf00d")
    assert {"t": dated.t, "key": dated.key} == {"t": UNSET, "key": UNSET, **expected}


def test_who_drives_keeps_to_the_pace_of_a_link_that_is_lost_for_a_while() -> None:
    """More would wait at the broker for the robot's return."""
    robot = RobotView(BASE)
    robot.receive(LINK, outgoing(BASE, "link", msgspec.to_builtins(link("thin", 4)), retain=True), 1.0, 1.0)
    assert robot.pace.valid_ms == 750
    for online in (False, True):
        robot.receive(ONLINE, outgoing(BASE, "online", {"t": 1, "online": online}), 2.0, 2.0)
        assert robot.pace.valid_ms == 750
    robot.receive(LINK, outgoing(BASE, "link", 7), 3.0, 3.0)
    assert robot.pace is WIDE


# -- who waits how long for a robot's silence, or for its answer


@pytest.mark.parametrize(("level", "limit_s"), {"wide": 2, "narrow": 3, "thin": 5}.items())
def test_a_robot_whose_link_is_known_is_awaited_for(level: LinkLevel, limit_s: float) -> None:
    discovery = Discovery()
    publish(discovery, "link", msgspec.to_builtins(link(level, 4)), retain=True)
    assert [discovery.awaits_heartbeat(limit_s + more_s) for more_s in (-0.1, 0.1)] == [True, False]
    assert limit_s == silent_after(link=level) <= COLLECT_S, "so long a stop of all waits"


def test_a_first_robot_is_awaited_as_one_of_which_nothing_is_known() -> None:
    assert [Discovery().awaits_heartbeat(after_s) for after_s in (1.9, 2.1)] == [True, False]
    discovery = Discovery()
    publish(discovery, "link", msgspec.to_builtins(link("thin", 4)), retain=True)
    publish(discovery, "online", {"t": 1}, now=1.0)
    assert not discovery.awaits_heartbeat(1.0)


# -- time stamps in payloads


@pytest.mark.parametrize(
    ("plain", "seconds"),
    [
        ({"t": 1710969600123}, 1710969600.123),
        ({"timestamp": 1710969600.5}, 1710969600.5),
        ({"timestamp": 1710969600123}, 1710969600.123),
        ({"t": 1710969600}, 1710969600.0),
        ({"t": 1710969600123, "timestamp": 1.5e9}, 1710969600.123),
        ({"t": 12345}, None),
        ({"t": "1710969600123"}, None),
        ({"t": math.nan}, None),
        ({"t": 10**400}, None),
        ({"t": -(10**400)}, None),
        ({"t": math.inf}, None),
        ({}, None),
        ([1710969600123], None),
    ],
)
def test_a_stamp_is_milliseconds_or_seconds_by_its_size(plain: Any, seconds: float | None) -> None:
    assert stamp_of(plain) == seconds
