"""At what rate, and how, commands go over a link of each kind."""

from __future__ import annotations

import msgspec
import pytest
from msgspec import UNSET

from pebble.contract import LINK, ONLINE
from pebble.contract.levels import LEVELS, silent_after
from pebble.contract.payloads import Drive, LinkLevel, LinkState
from pebble.extensions.operator.client.discovery import Discovery
from pebble.extensions.operator.client.estop import COLLECT_S, StopSender, new_name
from pebble.extensions.operator.client.pace_of_link import WIDE, Pace, pace_of
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.transports import QoS
from tests.ext.operator.client.estop_robot import outgoing

GOOB = "pebble/robots/goob"
MOVE = Drive(z=0.5, valid_ms=400)


def link(level: LinkLevel, hz: float, queue_ms: int = 40) -> LinkState:
    return LinkState(level=level, drive_hz=hz, rtt_ms=310, queue_ms=queue_ms, t=1)


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
    robot = RobotView(GOOB)
    robot.receive(LINK, outgoing(GOOB, "link", msgspec.to_builtins(link("thin", 4)), retain=True), 1.0, 1.0)
    assert robot.pace.valid_ms == 750
    for online in (False, True):
        robot.receive(ONLINE, outgoing(GOOB, "online", {"t": 1, "online": online}), 2.0, 2.0)
        assert robot.pace.valid_ms == 750
    robot.receive(LINK, outgoing(GOOB, "link", 7), 3.0, 3.0)
    assert robot.pace is WIDE


# -- who waits how long for a robot's silence, or for its answer


def test_a_stop_of_all_waits_for_silent_robots_as_on_the_thinnest_link() -> None:
    stop = StopSender(new_name(), by="ann", why="", now=0.0, robots=None)
    stop.receive(outgoing(GOOB, "online", {"t": 1}), COLLECT_S - 0.1)
    assert list(stop.robots) == [GOOB]
    assert max(silent_after(link=level) for level in LEVELS) == COLLECT_S


@pytest.mark.parametrize(("level", "limit_s"), {"wide": 2, "narrow": 3, "thin": 5}.items())
def test_a_robot_whose_link_is_known_is_awaited_for(level: LinkLevel, limit_s: float) -> None:
    discovery = Discovery()
    discovery.receive(outgoing(GOOB, "link", msgspec.to_builtins(link(level, 4)), retain=True), 0.0, 0.0)
    assert [discovery.awaits_heartbeat(limit_s + more_s) for more_s in (-0.1, 0.1)] == [True, False]
    assert limit_s == silent_after(link=level)


def test_a_first_robot_is_awaited_as_one_of_which_nothing_is_known() -> None:
    assert [Discovery().awaits_heartbeat(after_s) for after_s in (1.9, 2.1)] == [True, False]
    discovery = Discovery()
    discovery.receive(outgoing(GOOB, "link", msgspec.to_builtins(link("thin", 4)), retain=True), 0.0, 0.0)
    discovery.receive(outgoing(GOOB, "online", {"t": 1}), 1.0, 1.0)
    assert not discovery.awaits_heartbeat(1.0)
