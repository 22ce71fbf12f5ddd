"""Calibrations of wheels in a simulated room, and the command beside a robot."""

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

import pytest

from pebble.contract import DRIVE, MOTOR_POWER, TOUCH_SENSORS
from pebble.contract.payloads import Drive, TouchSensors
from pebble.errors import PebbleError
from pebble.extensions.calibrate.wheels import Person, Wanted, calibrate, check
from pebble.extensions.lab.simulation.motion import FULL_SPEED_MM_S, Wheels
from pebble.extensions.lab.simulation.world.script_robot import SimulatedRobot
from tests.ext.scripts.perception.test_odometry import powers, touches
from tests.ext.scripts.script.station import Station
from tests.ext.scripts.shipped.test_processes import Sensors
from tests.support import WAIT_S, Child, beside, cases, some, until

TRUE = Wheels(61.0 * 1.01, 61.0 * 0.99, 130.5 * 1.03)
ROOM = {"x_min": -0.5, "x_max": 2.4, "y_min": -2.0, "y_max": 2.0}


class Measured(SimulatedRobot):
    """A robot that publishes its hall sensors. ``at_step`` is called at each step of the clock."""

    def __init__(self, folder: Path, wheels: Wheels, *, noise: random.Random) -> None:
        sizes = {
            "left_wheel_mm": wheels.left_diameter_mm,
            "right_wheel_mm": wheels.right_diameter_mm,
            "track_mm": wheels.track_mm,
        }
        world = {"room": ROOM, "robots": {"goob": {"x": 0.0, "y": 0.0, **sizes}}}
        (folder / "room.json").write_text(json.dumps(world))
        super().__init__(folder / "room.json")
        self.at_step: Callable[[], None] = lambda: None
        self.turned = 0.0
        self._noise, self._received = noise, b""
        self._heading = self.body.pose.heading

    def _pass_step(self) -> None:
        super()._pass_step()
        self.turned += math.remainder(self.body.pose.heading - self._heading, math.tau)
        self._heading = self.body.pose.heading
        found, self._received = touches(self._received + self.body.read(), lambda: self._noise.gauss(0, 2))
        for values in found:
            self.receive(TOUCH_SENSORS, TouchSensors(value=values))
        self.at_step()

    def _drive(self, command: Drive) -> bool:
        self.receive(MOTOR_POWER, powers(command))
        return super()._drive(command)


class Measurer(Person):
    """A person who puts the robot on the line before each run and measures after it, with a tape's and an eye's errors.

    ``slips`` are what is typed wrongly: millimetres added to the way, by the number of the straight.
    """

    def __init__(self, robot: Measured, noise: random.Random, slips: dict[int, float]) -> None:
        self.told: list[str] = []
        self._robot, self._noise, self._slips = robot, noise, slips
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
        return f"{along:.0f} {end.y * 1000 + gauss(0, 3):.0f}"


def measure(
    folder: Path,
    wanted: Wanted,
    *,
    seed: int = 0,
    wheels: Wheels = TRUE,
    at_step: Callable[[Measured], object] = lambda _: None,
    slips: dict[int, float] | None = None,
) -> list[str]:
    """Run a whole calibration, or as much as is possible; return what the person was told."""
    noise = random.Random(seed)
    robot = Measured(folder, wheels, noise=noise)
    person = Measurer(robot, noise, slips or {})
    robot.at_step = lambda: at_step(robot)
    robot.run(lambda robot: calibrate(robot, person, wanted, robot.world.now), seconds=900)
    return person.told


QUICK = Wanted(length_m=0.3, straights=4, spins=2)


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
    measure(tmp_path, Wanted(), seed=seed, wheels=true)
    *steps, track = off_percent(tmp_path, true)
    assert max(map(abs, steps)) < 0.3
    assert abs(track) < 0.5
    written = json.loads((tmp_path / "odometry.json").read_text())
    assert (written["version"], written["counts"], written["truth"], written["runs"]) == (1, "once", "tape", 8)
    assert written["residual_mm"] < 5


def hold(*wheels: int) -> Callable[[Measured], None]:
    """Return what keeps these wheels from turning."""

    def held(robot: Measured) -> None:
        body = robot.body.mcu.body
        body.forward = lambda *powers: tuple(0.0 if n in wheels else powers[0] for n in range(2))  # type: ignore

    return held


@pytest.mark.parametrize(
    ("trouble", "said"),
    [
        (hold(0, 1), "it is not at its end after .* is it slower than --speed says"),
        (hold(1), r"a wheel has turned \d+ of 300 mm: does the other one turn"),
        (lambda robot: robot.receive(DRIVE, Drive(z=-0.1)), "it is not obeyed: a person"),
    ],
)
def test_what_ends_a_leg_writes_nothing(tmp_path: Path, trouble: Callable[[Measured], None], said: str) -> None:
    pending = [trouble]

    def at_step(robot: Measured) -> None:
        if pending and robot.body.motion.left_mm_s > 100:
            pending.pop()(robot)

    robots: list[Measured] = []
    with pytest.raises(PebbleError, match=f"1 of 6, straight there: {said}"):
        measure(tmp_path, QUICK, at_step=lambda r: (robots.append(r), at_step(r)))
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
        measure(tmp_path, QUICK, at_step=at_step)
    ((robot, at),) = stopped
    robot.world.run(max(0.0, at + 0.3 - robot.world.now()))
    assert robot.world.now() - at < 0.32 or leg == 0
    motion = robot.body.motion
    assert max(abs(motion.left_mm_s), abs(motion.right_mm_s)) < 0.01 * FULL_SPEED_MM_S
    assert not (tmp_path / "odometry.json").exists()


def test_a_run_beyond_3_sigma_is_repeated_and_one_that_stays_so_refused(tmp_path: Path) -> None:
    told = measure(tmp_path, Wanted(straights=4, length_m=0.6), slips={3: 60.0})
    (line,) = [line for line in told if "is repeated" in line]
    assert line.startswith("3 of 6, straight there is ")
    assert max(map(abs, off_percent(tmp_path))) < 1
    (tmp_path / "odometry.json").unlink()
    with pytest.raises(PebbleError, match=r"3 of 6, straight there stays .* does a wheel slip"):
        measure(tmp_path, Wanted(straights=4, length_m=0.6), slips=dict.fromkeys((3, 5, 7), 60.0))
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
        measure(tmp_path, QUICK)
    assert [path.name for path in tmp_path.iterdir()] == ["room.json"]


def test_an_emergency_stop_ends_it_and_nothing_is_written() -> None:
    ended = threading.Event()
    with closing(Station("zenoh")) as station, closing(Sensors(station)) as sensors:
        command = ["calibrate", "wheels", str(station.config_path), "--length", "0.3"]
        with beside(lambda: [sensors.roll(0.2, 0.0) for _ in iter(ended.is_set, True)], ended):
            program = Child(
                [sys.executable, "-m", "pebble.cli", *command],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            )  # fmt: skip
            assert program.stdin is not None
            print(file=program.stdin, flush=True)  # Enter drives
            assert until(lambda: station.moves(), 60), program.communicate(timeout=WAIT_S)[0]
            station.publish_state(latched=True, count=1, by="ann")
            assert until(station.rests)
            said = program.communicate(timeout=WAIT_S)[0]
        assert program.returncode == 3, said
        assert "emergency stop by ann" in said
        assert said.splitlines()[-1] == "pebble: ended; nothing was written"
        assert not (station.folder / "odometry.json").exists()
