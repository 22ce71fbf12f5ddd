"""Calibrations of wheels in a simulated room: the robot's firmware, its hall sensors, and a person who measures."""

from __future__ import annotations

import json
import math
import random
import re
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from pebble.config import parse
from pebble.contract import DRIVE
from pebble.contract.payloads import Drive
from pebble.errors import PebbleError
from pebble.extensions.calibrate.wheels import Wanted, check
from pebble.extensions.lab.simulation.motion import FULL_SPEED_MM_S, Wheels
from pebble.extensions.scripts.perception.odometry import Calibration
from pebble.extensions.scripts.perception.tags import Place, Tag
from tests.ext.calibrate.simulated import TAG, TRUE, Measured, measure
from tests.support import ROOT, cases, some

SHORT = {"length_m": 0.3, "straights": 4, "spins": 2}
QUICK = Wanted(**SHORT)


def off_percent(folder: Path, true: Wheels = TRUE) -> list[float]:
    """How far the file is from the truth: left step, right step, track."""
    found, step = json.loads((folder / "odometry.json").read_text()), math.pi / 10
    wanted = (true.left_diameter_mm * step, true.right_diameter_mm * step, true.track_mm)
    names = ("left_step_mm", "right_step_mm", "track_mm")
    return [100 * (found[name] / value - 1) for name, value in zip(names, wanted, strict=True)]


@pytest.mark.parametrize("seed", range(cases(1, 10)))
def test_wheels_1_percent_and_a_track_3_percent_off_are_found(seed: int, tmp_path: Path) -> None:
    signs = random.Random(seed)
    left, right, track = (1 + signs.choice((-1, 1)) * off for off in (0.01, 0.01, 0.03))
    true = Wheels(61.0 * left, 61.0 * right, 130.5 * track)
    _, person = measure(tmp_path, seed, wheels=true)
    *steps, track = off_percent(tmp_path, true)
    assert max(map(abs, steps)) < 0.3
    assert abs(track) < 0.5
    written = json.loads((tmp_path / "odometry.json").read_text())
    assert (written["version"], written["counts"], written["truth"], written["runs"]) == (1, "once", "tape", 8)
    assert written["residual_mm"] < 5
    assert len([line for line in person.told if "steps" in line]) == len(
        [line for line in person.told if "resid" in line]
    )


def test_a_gyroscope_measures_the_turns(tmp_path: Path) -> None:
    measure(tmp_path, wanted=Wanted(truth="gyro", straights=4, length_m=0.8), gyro=True)
    *steps, track = off_percent(tmp_path)
    assert max(map(abs, steps)) < 0.3
    assert abs(track) < 0.5
    with pytest.raises(PebbleError, match="no inertial sensor that agrees with the wheels"):
        measure(tmp_path, wanted=Wanted(truth="gyro", **SHORT))


class Finder:
    """A finder of tags that knows where the robot of this test is, and sees 27 degrees to each side."""

    robot: Measured
    hidden = False

    def __init__(self, *_: Any) -> None:
        pass

    def find(self, _picture: Any) -> list[Tag]:
        pose = self.robot.body.pose
        ahead, left = TAG["x"] - pose.x, TAG["y"] - pose.y
        angle = math.remainder(pose.heading - math.atan2(left, ahead), math.tau)
        place = Place(math.hypot(ahead, left, 0.08), angle, -0.08)
        return [] if self.hidden or abs(angle) > math.radians(27) else [Tag(13, np.zeros((4, 2)), place)]


@pytest.fixture
def finder(monkeypatch: pytest.MonkeyPatch) -> type[Finder]:
    """The finder in place of the one with OpenCV; pictures are not rendered."""
    monkeypatch.setattr("pebble.extensions.calibrate.wheels.TagFinder", Finder)
    monkeypatch.setattr(Finder, "hidden", False)

    def picture(robot: Measured, max_age: float = 0.5) -> object:
        Finder.robot = robot
        robot._pass_step()
        return object()

    monkeypatch.setattr(Measured, "picture", picture)
    return Finder


def test_a_tag_measures_ways_and_turns_without_a_person(tmp_path: Path, finder: type[Finder]) -> None:
    measure(tmp_path, wanted=Wanted(truth="tag", straights=4, length_m=0.8))
    *steps, track = off_percent(tmp_path)
    assert max(map(abs, steps)) < 0.3
    assert abs(track) < 0.5


@pytest.mark.thorough
def test_rendered_pictures_of_a_tag_give_the_heading_and_a_scale_within_2_percent(tmp_path: Path) -> None:
    measure(tmp_path, wanted=Wanted(truth="tag", **SHORT))
    left, right, track = off_percent(tmp_path)
    assert abs(left - right) < 0.3
    assert abs(track - (left + right) / 2) < 0.5
    assert max(abs(left), abs(right)) < 2


def hide(_robot: Measured) -> None:
    Finder.hidden = True


def nearer(robot: Measured) -> None:
    robot.body.place(1.95, 0.0, 0.0)


def hold(*wheels: int) -> Callable[[Measured], None]:
    """Return what keeps these wheels from turning."""

    def held(robot: Measured) -> None:
        body = robot.body.mcu.body
        body.forward = lambda *powers: tuple(0.0 if n in wheels else powers[0] for n in range(2))  # type: ignore

    return held


def drive_by_hand(robot: Measured) -> None:
    robot.receive(DRIVE, Drive(z=-0.1))


@pytest.mark.parametrize(
    ("truth", "trouble", "said"),
    [
        ("tag", hide, "1 of 6, straight there: it has lost tag 13"),
        ("tag", nearer, "1 of 6, straight there: the tag is nearer than 0.4 m"),
        ("tape", hold(0, 1), "1 of 6, straight there: it is not at its end after .* is it slower than --speed says"),
        ("tape", hold(1), r"1 of 6, straight there: a wheel has turned \d+ of 300 mm: does the other one turn"),
        ("tape", drive_by_hand, "1 of 6, straight there: it is not obeyed: a person drives"),
    ],
)
def test_what_ends_a_leg_writes_nothing(
    tmp_path: Path, finder: type[Finder], truth: Any, trouble: Callable[[Measured], None], said: str
) -> None:
    pending = [trouble]

    def at_step(robot: Measured) -> None:
        if pending and robot.body.motion.left_mm_s > 100:
            pending.pop()(robot)

    robots: list[Measured] = []
    with pytest.raises(PebbleError, match=said):
        measure(tmp_path, wanted=Wanted(truth=truth, **SHORT), at_step=lambda r: (robots.append(r), at_step(r)))
    assert not (tmp_path / "odometry.json").exists()
    robots[0].world.run(0.5)
    assert robots[0].body.motion.left_mm_s == 0


@pytest.mark.parametrize("leg", some(range(7), 3))
def test_stop_in_any_leg_brings_it_to_rest_and_nothing_is_written(leg: int, tmp_path: Path) -> None:
    """Leg 0 is the rest before the first straight."""
    legs, moved, stopped = 0, False, []

    def at_step(robot: Measured) -> None:
        nonlocal legs, moved
        moves = max(abs(robot.body.motion.left_mm_s), abs(robot.body.motion.right_mm_s)) > 150
        legs, moved = legs + (moves and not moved), moves or (moved and robot.body.motion.left_mm_s != 0)
        if not stopped and legs == leg and robot.world.now() > 2:
            stopped.append((robot, robot.world.now()))
            robot.estop()

    before_it_drove = pytest.raises(PebbleError, match="it is not obeyed: the robot is stopped by a person")
    with before_it_drove if leg == 0 else nullcontext():
        measure(tmp_path, wanted=QUICK, at_step=at_step)
    ((robot, at),) = stopped
    robot.world.run(max(0.0, at + 0.3 - robot.world.now()))
    assert robot.world.now() - at < 0.32 or leg == 0
    motion = robot.body.motion
    assert max(abs(motion.left_mm_s), abs(motion.right_mm_s)) < 0.01 * FULL_SPEED_MM_S
    assert not (tmp_path / "odometry.json").exists()


def test_a_run_beyond_3_sigma_is_repeated_and_one_that_stays_so_refused(tmp_path: Path) -> None:
    _, person = measure(tmp_path, wanted=Wanted(straights=4, length_m=0.6), slips={3: 60.0})
    (line,) = [line for line in person.told if "is repeated" in line]
    assert line.startswith("3 of 6, straight there is ")
    assert max(map(abs, off_percent(tmp_path))) < 1
    (tmp_path / "odometry.json").unlink()
    with pytest.raises(PebbleError, match=r"3 of 6, straight there stays .* does a wheel slip"):
        measure(tmp_path, wanted=Wanted(straights=4, length_m=0.6), slips=dict.fromkeys((3, 5, 7), 60.0))
    assert not (tmp_path / "odometry.json").exists()


@pytest.mark.parametrize(
    ("straights", "spins", "said"),
    [(3, 2, "4 straights and 2 spins are the least"), (4, 1, "2 spins are the least"), (5, 2, "an even number")],
)
def test_too_few_runs_are_refused(straights: int, spins: int, said: str) -> None:
    with pytest.raises(PebbleError, match=said):
        check(Wanted(straights=straights, spins=spins))


def test_without_hall_sensors_the_key_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Measured, "receive", lambda *_: None)
    with pytest.raises(PebbleError, match=r"no hall sensors: set .*publish_touch_sensors"):
        measure(tmp_path, wanted=QUICK)
    assert [path.name for path in tmp_path.iterdir()] == ["room.json"]


def test_the_files_in_the_document(tmp_path: Path) -> None:
    config, written = re.findall(r"```json\n(.*?)```", (ROOT / "docs/ext/calibrate.md").read_text(), re.DOTALL)
    telemetry = parse(json.loads(config), folder=tmp_path, env={}).services.serial_mcu_bridge.telemetry
    assert telemetry.publish_touch_sensors
    assert msgspec.json.decode(written, type=Calibration).track_mm == 134.382
