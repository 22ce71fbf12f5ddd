"""Following a tag: single decisions, and the closed loop in lockstep."""

from __future__ import annotations

import json
import math
import random
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from pebble.contract import APRILTAG_DATA, VIDEO_OVERLAYS
from pebble.contract.payloads import WheelOdometry
from pebble.extensions.lab.simulation.world.script_robot import SimulatedRobot, load_script
from pebble.extensions.scripts.perception.follow import Command, Follower, FollowSettings
from pebble.extensions.scripts.perception.odom_follow import OdomFollower, Pose, pose_of
from pebble.extensions.scripts.perception.rate import Rate
from pebble.extensions.scripts.perception.tags import Place
from tests.support import ROOT

AHEAD = Place(0.6, 0.0)
FAR = Place(2.0, 0.0)


def follower(**settings: Any) -> Follower:
    return Follower(FollowSettings(**settings))


def sign(value: float) -> int:
    return (value > 0) - (value < 0)


@pytest.mark.parametrize(
    ("distance", "angle", "x", "z"),
    [(0.6, 0.0, 0, 0), (2.0, 0.0, 0, 1), (2.0, 0.2, 1, 1), (2.0, -0.2, -1, 1), (0.4, 0.0, 0, -1)],
)
def test_it_steers_towards_the_distance_and_stands_there(distance: float, angle: float, x: int, z: int) -> None:
    command = follower().step(0.0, Place(distance, angle))
    assert (sign(command.x), sign(command.z)) == (x, z)


def test_powers_have_a_minimum_a_maximum_and_room_for_steering() -> None:
    assert follower(vision_forward_kp=0.1).step(0.0, FAR).z == 0.8, "far away"
    command = follower().step(0.0, Place(3.0, 0.3))
    assert command.x + command.z == pytest.approx(1.0)
    assert follower(turn_power=0.3).step(0.0, Place(2.0, 0.9)).x == 0.3, "the most"
    assert follower().step(0.0, Place(0.6, 0.09)).x == pytest.approx(0.12), "the least"
    assert follower().step(0.0, Place(0.6, 0.07)).x == 0.0, "within the deadband"


def test_outside_of_the_cone_it_turns_in_pulses_with_pauses() -> None:
    robot = follower(turn_pulse_s=0.1, turn_cooldown_s=0.2)
    commands = [robot.step(0.1 * tick, Place(2.0, -0.4)) for tick in range(7)]
    assert [command.x < 0 for command in commands] == [True, False, False, True, False, False, True]
    assert {command.z for command in commands} == {0.0}


def test_holding_ends_only_beyond_threshold_and_hysteresis() -> None:
    robot = follower()
    assert robot.step(0.0, Place(0.67, 0.0)).z > 0, "not arrived yet"
    assert robot.step(0.1, AHEAD).z == 0
    assert robot.step(0.2, Place(0.67, 0.0)).z == 0
    assert robot.step(0.3, Place(0.69, 0.0)).z > 0


def test_a_picture_without_the_tag_interrupts_nothing_but_a_lost_tag_stops_and_is_searched() -> None:
    robot = follower()
    driving = robot.step(0.0, Place(2.0, -0.2))
    assert robot.step(0.1, None) == driving
    assert robot.step(0.5, None) == Command(reason="wait")
    search = robot.step(0.8, None)
    assert (search.x, search.reason) == (-0.5, "search"), "to the side where it was"


def test_a_search_may_change_its_direction() -> None:
    robot = follower(search_reverse_after_s=2.0, search_pause_s=0.0, turn_pulse_s=0.1)
    robot.step(0.0, Place(2.0, 0.1))
    assert robot.step(1.0, None).x > 0
    assert robot.step(2.1, None).x < 0


def test_a_near_tag_that_fills_the_picture_is_backed_away_from_before_a_search() -> None:
    robot = follower()
    robot.step(0.0, AHEAD)
    reasons = [robot.step(0.1 * tick, None).reason for tick in range(1, 14)]
    assert reasons == ["wait"] * 3 + ["back away"] * 6 + ["search"] * 4
    assert robot.step(2.0, Place(0.61, 0.0)).reason == "hold"


def test_a_rate_repeats_nothing_and_may_be_raised() -> None:
    rate = Rate(10.0)
    assert sum(rate.due(tick / 15) for tick in range(1500)) == pytest.approx(1000, abs=1)
    rate = Rate(10.0)
    assert [rate.due(now) for now in (0.0, 5.0, 5.01, 5.05, 5.11)] == [True, True, False, False, True]
    rate = Rate(2.0)
    assert rate.due(0.0)
    rate.hz = 20.0
    assert [rate.due(now) for now in (0.01, 0.07)] == [False, True]


# -- by odometry


def blind(place: Place = FAR) -> OdomFollower:
    """A tag was seen at 0 s from the origin."""
    robot = OdomFollower(FollowSettings())
    robot.see(0.0, place, Pose(0.0, 0.0, 0.0))
    robot.step(0.0, Pose(0.0, 0.0, 0.0))
    return robot


def test_it_drives_on_to_where_the_tag_was() -> None:
    robot = blind()
    command = robot.step(1.0, Pose(0.5, 0.0, 0.0))
    assert (command.reason, command.x) == ("odometry", pytest.approx(0.0))
    assert command.z == 0.9
    assert robot.step(1.1, Pose(0.5, 0.0, 0.5)).x > 0, "the goal is to the right"
    assert robot.step(2.0, Pose(1.36, 0.0, 0.0)).reason == "goal reached", "1.4 m, within 6 cm"
    assert robot.step(2.5, Pose(1.36, 0.0, 0.0)).reason == "search"


def test_the_goal_is_on_the_way_to_the_tag() -> None:
    robot = blind(Place(1.6, math.radians(10)))
    goal = Pose(math.cos(math.radians(10)), -math.sin(math.radians(10)), 0.0)
    assert robot.step(1.0, goal).reason == "goal reached"


def test_it_drives_blind_for_a_bounded_time_and_without_odometry_waits_and_searches() -> None:
    robot = blind()
    assert robot.step(5.9, Pose(0.5, 0.0, 0.0)).reason == "odometry"
    assert robot.step(6.1, Pose(0.5, 0.0, 0.0)).z == 0.0
    robot = blind()
    assert [robot.step(now, None).reason for now in (0.2, 0.5, 1.0)] == ["drive", "wait", "search"]
    robot = blind(Place(1.0, 0.6))
    assert [robot.step(now, None).reason for now in (0.3, 0.4)] == ["turn", "wait"], "late locations are no picture"


@pytest.mark.parametrize(
    ("value", "unit"),
    [
        ({"x_mm": 1500, "y_mm": -500.0, "heading_rad": 0.5}, "mm"),
        ({"x": 1.5, "y": -0.5, "theta_rad": 0.5}, "m"),
    ],
)
def test_poses_of_other_producers(value: dict[str, Any], unit: str) -> None:
    assert pose_of(WheelOdometry(value=value, unit=unit, timestamp=0.0)) == pytest.approx((1.5, -0.5, 0.5))


def test_what_is_no_pose_is_none() -> None:
    numbers: list[Any] = ["1", math.nan]
    wrong = [{}, {"x_mm": 1, "y_mm": 2}, *({"x_mm": number, "y_mm": 2, "heading_rad": 0} for number in numbers)]
    assert [pose_of(WheelOdometry(value=value, timestamp=0.0)) for value in wrong] == [None] * 4
    assert pose_of(None) is None


# -- the closed loop


def test_a_robot_arrives_at_the_tag_although_its_pictures_are_blurred(tmp_path: Path) -> None:
    """From 1 to 2.8 m away, up to 69 degrees off, as a seed draws it."""
    chosen, world = random.Random(6), tmp_path / "world.json"
    distance, aside = chosen.uniform(1.0, 2.8), chosen.uniform(-40, 40)
    heading = 180 + aside + chosen.uniform(-69, 69)
    x, y = distance * math.cos(math.radians(aside)), distance * math.sin(math.radians(aside))
    robots = {"goob": {"x": x, "y": y, "heading_deg": heading}}
    tags, camera = [{"id": 13, "x": 0.0, "y": 0.0}], {"motion_blur_ms": 30, "jpeg_quality": 20}
    world.write_text(json.dumps({"tags": tags, "camera": camera, "robots": robots}))
    robot = SimulatedRobot(world)
    script = load_script(ROOT / "pebble/extensions/scripts/shipped/apriltag-follow/run.py")
    script.time = SimpleNamespace(monotonic=robot.world.now, time=robot.world.now)  # type: ignore[attr-defined]
    robot.run(script.main, script.Options(), seconds=15.0)
    assert robot.distance_to(tag=13) == pytest.approx(0.6, abs=0.05)
    data = [value for channel, value in robot.published if channel is APRILTAG_DATA]
    shapes = [value.shapes for channel, value in robot.published if channel is VIDEO_OVERLAYS]
    assert any(tag.detected for tag in data)
    assert any(shapes)
    assert (data[-1].detected, shapes[-1]) == (False, []), "at its end"
    assert 100 < len(data) <= 152, "10 a second"
