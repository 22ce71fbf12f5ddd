"""Who waits how long for a robot's silence, or for its answer, at each level of its link; in virtual time."""

from __future__ import annotations

import json

import pytest

from pebble.contract import LINK, ONLINE
from pebble.contract.levels import LEVELS, link_of, silent_after
from pebble.contract.payloads import LinkLevel
from pebble.extensions.operator.client.discovery import Discovery
from pebble.extensions.operator.client.estop import COLLECT_S, StopSender, new_name
from pebble.extensions.operator.client.names import Names
from pebble.extensions.operator.client.pace_of_link import pace_of
from pebble.extensions.operator.client.scripts import RobotScripts
from pebble.transports import Message

BASE = "pebble/robots/goob"
NEAR_S = 0.1


def link(level: LinkLevel, base: str = BASE) -> Message:
    body = {"level": level, "drive_hz": 4, "rtt_ms": 600, "queue_ms": 0, "t": 1}
    return Message(LINK.topic(base), json.dumps(body).encode(), retain=True)


def heartbeat(base: str = BASE) -> Message:
    return Message(ONLINE.topic(base), b'{"t": 1}')


@pytest.mark.parametrize(("level", "limit_s"), {"wide": 2, "narrow": 3, "thin": 5}.items())
def test_a_robot_whose_link_is_known_is_awaited_for(level: LinkLevel, limit_s: float) -> None:
    discovery = Discovery()
    discovery.receive(link(level), 0.0, 0.0)
    assert [discovery.awaits_heartbeat(limit_s + more_s) for more_s in (-NEAR_S, NEAR_S)] == [True, False]
    assert limit_s == silent_after(link=level)


@pytest.mark.parametrize(("level", "scripts_s", "others_s"), [("wide", 5, 2), ("narrow", 10, 10), ("thin", 10, 10)])
def test_an_answer_is_awaited_for(level: LinkLevel, scripts_s: float, others_s: float) -> None:
    scripts = RobotScripts(Names(BASE))
    scripts.receive(link(level))
    assert (scripts.answer_s, pace_of(link_of(link(level).payload)).answer_s) == (scripts_s, others_s)


def test_a_stop_of_all_waits_for_silent_robots_as_on_the_thinnest_link() -> None:
    stop = StopSender(new_name(), by="ann", why="", now=0.0, robots=None)
    stop.receive(heartbeat(), COLLECT_S - NEAR_S)
    assert list(stop.robots) == [BASE]
    assert max(silent_after(link=level) for level in LEVELS) == COLLECT_S


def test_a_first_robot_is_awaited_as_one_of_which_nothing_is_known() -> None:
    assert [Discovery().awaits_heartbeat(after_s) for after_s in (1.9, 2.1)] == [True, False]
    discovery = Discovery()
    discovery.receive(link("thin"), 0.0, 0.0)
    discovery.receive(heartbeat(), 1.0, 1.0)
    assert not discovery.awaits_heartbeat(1.0)
