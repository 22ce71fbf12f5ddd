"""What an operator can learn from a broker alone."""

from __future__ import annotations

import json

from pebble.demo.discovery import Discovery, Liveness, Sighting
from pebble.transports import Message

BASE = "pebble/robots/goob"
WALL = 1_760_000_000.0


def say(discovery: Discovery, metric: str, body: object, *, now: float = 0.0, retain: bool = False) -> None:
    message = Message(f"{BASE}/outgoing/{metric}", json.dumps(body).encode(), retain=retain)
    discovery.hear(message, now, WALL + now)


def beat(discovery: Discovery, *times: float) -> Sighting:
    for now in times:
        say(discovery, "online", {"t": int((WALL + now - 0.01) * 1000)}, now=now)
    return discovery.sightings[BASE]


def test_heartbeats_make_a_robot_online_and_silence_offline() -> None:
    seen = beat(Discovery(), 0.0, 0.25)
    assert seen.liveness.online(0.3) is None, "two heartbeats are too few to know their rhythm"
    seen = beat(Discovery(), 0.0, 0.25, 0.5)
    assert seen.liveness.online(0.9) is True
    assert seen.liveness.online(1.01) is False


def test_a_will_means_offline_at_once() -> None:
    discovery = Discovery()
    seen = beat(discovery, 0.0, 0.25, 0.5)
    say(discovery, "online", {"t": int(WALL * 1000), "online": False}, now=0.6)
    assert seen.liveness.online(0.6) is False


def test_a_kept_heartbeat_is_no_sign_of_life() -> None:
    discovery = Discovery()
    for now in (0.0, 0.25, 0.5):
        say(discovery, "online", {"t": int((WALL + now) * 1000)}, now=now, retain=True)
    assert discovery.sightings[BASE].liveness.heard_at is None


def test_a_slow_link_widens_the_window() -> None:
    liveness = Liveness()
    for now in (0.0, 0.25, 0.5):
        liveness.heartbeat(now, 0.5)
    assert liveness.online(2.4) is True
    assert liveness.online(2.6) is False


def test_a_robot_is_ready_once_it_says_how_to_drive_it() -> None:
    discovery = Discovery()
    seen = beat(discovery, 0.0, 0.25, 0.5)
    assert not seen.ready(0.6)
    value = {"transport": {"kind": "zenoh"}, "drive": {"available": True, "topic": "somewhere/else"}}
    say(discovery, "capabilities", {"schema": "pebble-capabilities/v1", "t": 1, "value": value}, now=0.6, retain=True)
    assert seen.ready(0.6)
    assert (seen.transport, seen.drive_topic) == ("zenoh", "somewhere/else")


def test_battery_and_message_count() -> None:
    discovery = Discovery()
    say(discovery, "charging-level", {"value": 7.9, "unit": "v"})
    say(discovery, "charging-status", {"value": None})
    seen = discovery.sightings[BASE]
    assert (seen.volts, seen.charging, seen.messages) == (7.9, None, 2)


def test_nonsense_is_passed_over() -> None:
    discovery = Discovery()
    say(discovery, "online", "nonsense")
    say(discovery, "capabilities", {"value": 3})
    discovery.hear(Message("somebody/else", b""), 0.0, WALL)
    assert list(discovery.sightings) == [BASE]
    assert discovery.sightings[BASE].liveness.heard_at is None
