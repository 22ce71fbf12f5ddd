"""Discovery of robots by what they publish to a broker."""

from __future__ import annotations

import json

from pebble.client.discovery import DiscoveredRobot, Discovery, Liveness
from pebble.transports import Message

BASE = "pebble/robots/goob"
WALL = 1_760_000_000.0


def publish(discovery: Discovery, metric: str, body: object, *, now: float = 0.0, retain: bool = False) -> None:
    message = Message(f"{BASE}/outgoing/{metric}", json.dumps(body).encode(), retain=retain)
    discovery.receive(message, now, WALL + now)


def publish_heartbeats(discovery: Discovery, *times: float) -> DiscoveredRobot:
    for now in times:
        publish(discovery, "online", {"t": int((WALL + now - 0.01) * 1000)}, now=now)
    return discovery.robots[BASE]


def test_heartbeats_make_a_robot_online_and_silence_offline() -> None:
    seen = publish_heartbeats(Discovery(), 0.0, 0.25)
    assert seen.liveness.online(0.3) is None, "two heartbeats are too few to know their interval"
    seen = publish_heartbeats(Discovery(), 0.0, 0.25, 0.5)
    assert seen.liveness.online(0.9) is True
    assert seen.liveness.online(1.01) is False


def test_a_will_means_offline_at_once() -> None:
    discovery = Discovery()
    seen = publish_heartbeats(discovery, 0.0, 0.25, 0.5)
    publish(discovery, "online", {"t": int(WALL * 1000), "online": False}, now=0.6)
    assert seen.liveness.online(0.6) is False


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


def test_a_slow_link_widens_the_window() -> None:
    liveness = Liveness()
    for now in (0.0, 0.25, 0.5):
        liveness.heartbeat(now, 0.5)
    assert liveness.online(2.4) is True
    assert liveness.online(2.6) is False


def test_a_robot_is_ready_once_it_publishes_how_to_drive_it() -> None:
    discovery = Discovery()
    seen = publish_heartbeats(discovery, 0.0, 0.25, 0.5)
    assert not seen.ready(0.6)
    value = {"transport": {"kind": "zenoh"}, "drive": {"available": True, "topic": "somewhere/else"}}
    publish(
        discovery, "capabilities", {"schema": "pebble-capabilities/v1", "t": 1, "value": value}, now=0.6, retain=True
    )
    assert seen.ready(0.6)
    assert (seen.transport, seen.drive_topic) == ("zenoh", "somewhere/else")


def test_topics_of_another_robot_in_capabilities_are_not_used() -> None:
    discovery = Discovery()
    seen = publish_heartbeats(discovery, 0.0, 0.25, 0.5)
    drive, lights = "pebble/robots/another/incoming/drive-values", "pebble/robots/another/incoming/lights-solid"
    value = {"drive": {"available": True, "topic": drive}, "lights": {"solid_topic": lights}}
    publish(
        discovery, "capabilities", {"schema": "pebble-capabilities/v1", "t": 1, "value": value}, now=0.6, retain=True
    )
    assert (seen.drive_topic, seen.lights_topic(flash=False), seen.ready(0.6)) == (None, None, False)
    assert seen.estop.drive_topic == f"{BASE}/incoming/drive-values"


def test_battery_and_message_count() -> None:
    discovery = Discovery()
    publish(discovery, "charging-level", {"value": 7.9, "unit": "v"})
    publish(discovery, "charging-status", {"value": None})
    seen = discovery.robots[BASE]
    assert (seen.volts, seen.charging, seen.messages.count) == (7.9, None, 2)


def test_nonsense_is_passed_over() -> None:
    discovery = Discovery()
    publish(discovery, "online", "nonsense")
    publish(discovery, "capabilities", {"value": 3})
    discovery.receive(Message("other/topic", b""), 0.0, WALL)
    assert list(discovery.robots) == [BASE]
    assert discovery.robots[BASE].liveness.received_at is None


def test_a_stopped_robot_is_known_as_such() -> None:
    discovery = Discovery()
    publish(discovery, "online", {"t": 1})
    assert not discovery.robots[BASE].latched
    state = {"latched": True, "boot": "0", "count": 1, "recent": [], "by": "ann", "why": "dog", "since": 1}
    publish(discovery, "estop/serial", state, retain=True)
    seen = discovery.robots[BASE]
    assert seen.latched
    assert seen.stopped_by is not None
    assert seen.stopped_by.by == "ann"
    publish(discovery, "estop/serial", state | {"latched": False}, retain=True)
    assert (seen.latched, seen.stopped_by) == (False, None)
