"""Calibrations of wheels in a simulated room, by a person, a tag or a gyroscope, and the command beside a robot."""

from __future__ import annotations

import json
import math
import random
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import closing, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pebble.contract import DRIVE, IMU_FAST, MOTOR_POWER, TOUCH_SENSORS
from pebble.contract.payloads import Drive, TouchSensors
from pebble.errors import PebbleError
from pebble.extensions.calibrate.wheels import Wanted, calibrate, check
from pebble.extensions.lab.simulation.motion import FULL_SPEED_MM_S, Wheels
from pebble.extensions.lab.simulation.world.script_robot import SimulatedRobot
from pebble.extensions.scripts.perception.tags import Place, Tag
from tests.ext.scripts.perception.test_odometry import powers, touches, turning
from tests.ext.scripts.script.station import Station
from tests.ext.scripts.shipped.test_processes import Sensors
from tests.support import WAIT_S, Child, beside, cases, some, until

TRUE = Wheels(61.0 * 1.01, 61.0 * 0.99, 130.5 * 1.03)
ROOM = {"x_min": -0.5, "x_max": 2.4, "y_min": -2.0, "y_max": 2.0}
TAG = {"id": 13, "x": 2.3, "y": 0.0, "z": 0.2, "yaw_deg": 180.0}


class Measured(SimulatedRobot):
    """A robot that publishes its hall sensors, and an inertial sensor if there is ``gyro``.

    ``at_step`` is called at each step of the clock.
    """

    def __init__(self, folder: Path, wheels: Wheels = TRUE, *, gyro: bool = False, noise: random.Random) -> None:
        sizes = {
            "left_wheel_mm": wheels.left_diameter_mm,
            "right_wheel_mm": wheels.right_diameter_mm,
            "track_mm": wheels.track_mm,
        }
        world = {"room": ROOM, "tags": [TAG], "robots": {"goob": {"x": 0.0, "y": 0.0, **sizes}}}
        (folder / "room.json").write_text(json.dumps(world))
        super().__init__(folder / "room.json")
        self.at_step: Callable[[], None] = lambda: None
        self.turned = 0.0
        self._gyro, self._noise, self._received = gyro, noise, b""
        self._heading = self.body.pose.heading

    def _pass_step(self) -> None:
        super()._pass_step()
        self.turned += math.remainder(self.body.pose.heading - self._heading, math.tau)
        self._heading = self.body.pose.heading
        found, self._received = touches(self._received + self.body.read(), lambda: self._noise.gauss(0, 2))
        for values in found:
            self.receive(TOUCH_SENSORS, TouchSensors(value=values))
        if self._gyro and round(self.world.now() * 1000) % 10 == 0:
            motion = self.body.motion
            z = math.degrees((motion.right_mm_s - motion.left_mm_s) / motion.wheels.track_mm)
            self.receive(IMU_FAST, turning(z + 0.3 + self._noise.gauss(0.0, 0.05), self.world.now()))
        self.at_step()

    def _drive(self, command: Drive) -> bool:
        self.receive(MOTOR_POWER, powers(command))
        return super()._drive(command)


class Measurer:
    """A person who puts the robot on the line before each run and measures after it, with a tape's and an eye's errors.

    ``slips`` are what is typed wrongly: millimetres added to the way, by the number of the straight.
    """

    def __init__(self, robot: Measured, noise: random.Random, slips: dict[int, float] | None = None) -> None:
        self.told: list[str] = []
        self._robot, self._noise, self._slips = robot, noise, slips or {}
        self._straights = 0
        self._began = robot.body.pose
        self._turned = 0.0

    def tell(self, line: str) -> None:
        self.told.append(line)

    def ask(self, question: str) -> str:
        robot, gauss = self._robot, self._noise.gauss
        if "Enter drives" in question:
            if "line" in question:
                robot.body.place(1.6 if "back" in question else 0.0, 0.0, gauss(0, math.radians(0.3)))
            self._began, self._turned = robot.body.pose, robot.turned
            return ""
        if "degrees" in question:
            past = abs(robot.turned - self._turned) - 3 * math.tau
            return f"{math.degrees(past) + gauss(0, 2):.0f}"
        end, self._straights = robot.body.pose, self._straights + 1
        along = abs(end.x - self._began.x) * 1000 + gauss(0, 2) + self._slips.pop(self._straights, 0.0)
        beside = f" {end.y * 1000 + gauss(0, 3):.0f}" if "left of it" in question else ""
        return f"{along:.0f}{beside}"


def measure(folder: Path, seed: int = 0, wanted: Wanted | None = None, **options: Any) -> tuple[Measured, Measurer]:
    """Run a whole calibration, or as much as is possible; ``at_step(robot)`` at each step of the clock."""
    noise = random.Random(seed)
    at_step, slips = options.pop("at_step", lambda _: None), options.pop("slips", None)
    robot = Measured(folder, noise=noise, **options)
    person = Measurer(robot, noise, slips)
    robot.at_step = lambda: at_step(robot)
    robot.run(lambda robot: calibrate(robot, person, wanted or Wanted(), robot.world.now), seconds=900)
    return robot, person


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
    measure(tmp_path, seed, wheels=true)
    *steps, track = off_percent(tmp_path, true)
    assert max(map(abs, steps)) < 0.3
    assert abs(track) < 0.5
    written = json.loads((tmp_path / "odometry.json").read_text())
    assert (written["version"], written["counts"], written["truth"], written["runs"]) == (1, "once", "tape", 8)
    assert written["residual_mm"] < 5


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


@pytest.mark.parametrize("truth", ["tag", "gyro"])
def test_a_tag_measures_ways_and_turns_without_a_person_and_a_gyroscope_the_turns(
    tmp_path: Path, finder: type[Finder], truth: Any
) -> None:
    measure(tmp_path, wanted=Wanted(truth=truth, straights=4, length_m=0.8), gyro=truth == "gyro")
    *steps, track = off_percent(tmp_path)
    assert max(map(abs, steps)) < 0.3
    assert abs(track) < 0.5


def test_a_spin_that_ends_past_its_tag_turns_back(tmp_path: Path, finder: type[Finder]) -> None:
    slow_steps, pushed = 0, False

    def at_step(robot: Measured) -> None:
        nonlocal slow_steps, pushed
        pose, mm_s = robot.body.pose, abs(robot.body.motion.left_mm_s)
        if not mm_s and slow_steps > 50 and not pushed:  # fewer: a fast leg that began and ended
            robot.body.place(pose.x, pose.y, pose.heading + math.radians(50))
            pushed = True
        slow_steps = slow_steps + (20 < mm_s < 80) if mm_s else 0

    measure(tmp_path, wanted=Wanted(truth="tag", **SHORT), at_step=at_step)
    assert pushed


@pytest.mark.thorough
def test_rendered_pictures_of_a_tag_give_the_heading_and_a_scale_within_2_percent(tmp_path: Path) -> None:
    measure(tmp_path, wanted=Wanted(truth="tag", **SHORT))
    left, right, track = off_percent(tmp_path)
    assert abs(left - right) < 0.3
    assert abs(track - (left + right) / 2) < 0.5
    assert max(abs(left), abs(right)) < 2


def hide(_robot: Measured) -> None:
    Finder.hidden = True


def hold(*wheels: int) -> Callable[[Measured], None]:
    """Return what keeps these wheels from turning."""

    def held(robot: Measured) -> None:
        body = robot.body.mcu.body
        body.forward = lambda *powers: tuple(0.0 if n in wheels else powers[0] for n in range(2))  # type: ignore

    return held


@pytest.mark.parametrize(
    ("truth", "trouble", "said"),
    [
        ("tag", hide, "1 of 6, straight there: it has lost tag 13"),
        ("tag", lambda robot: robot.body.place(1.95, 0.0, 0.0), "1 of 6, straight there: the tag is nearer than 0.4 m"),
        ("tape", hold(0, 1), "1 of 6, straight there: it is not at its end after .* is it slower than --speed says"),
        ("tape", hold(1), r"1 of 6, straight there: a wheel has turned \d+ of 300 mm: does the other one turn"),
        (
            "tape",
            lambda robot: robot.receive(DRIVE, Drive(z=-0.1)),
            "1 of 6, straight there: it is not obeyed: a person",
        ),
        ("gyro", hide, "no inertial sensor that agrees with the wheels"),
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


@pytest.mark.parametrize("leg", some(range(7), 4))
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


def test_an_emergency_stop_ends_it_and_nothing_is_written() -> None:
    ended = threading.Event()
    with closing(Station("zenoh")) as station, closing(Sensors(station)) as sensors:
        command = ["calibrate", "wheels", str(station.config_path), "--truth", "tag", "--length", "0.3"]
        with beside(lambda: [sensors.roll(0.2, 0.0) for _ in iter(ended.is_set, True)], ended):
            program = Child(
                [sys.executable, "-m", "pebble.cli", *command],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            )  # fmt: skip
            assert until(lambda: station.moves(), 60), program.communicate(timeout=WAIT_S)[0]
            station.publish_state(latched=True, count=1, by="ann")
            assert until(station.rests)
            said = program.communicate(timeout=WAIT_S)[0]
        assert program.returncode == 3, said
        assert "emergency stop by ann" in said
        assert said.splitlines()[-1] == "pebble: ended; nothing was written"
        assert not (station.folder / "odometry.json").exists()
