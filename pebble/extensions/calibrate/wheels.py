"""Calibrates the wheels: straight runs there and back, spins, and a file that wheel odometry uses."""

import math
import time
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Literal, NamedTuple, Protocol

from msgspec import Struct, json

from pebble.errors import PebbleError
from pebble.extensions.calibrate.fit import LIMIT_SIGMA, NOISE, Fit, Run, fit
from pebble.extensions.calibrate.legs import NEAREST_M, POWER, Counts, Legs
from pebble.extensions.scripts.perception.camera_model import CameraModel
from pebble.extensions.scripts.perception.odometry import CALIBRATION, Calibration, OdometrySettings
from pebble.extensions.scripts.perception.tags import FAMILY, Place, TagFinder
from pebble.extensions.scripts.script import Robot
from pebble.runtime.as_owner import as_owner
from pebble.runtime.whole_file import write

LEAST_STRAIGHTS, LEAST_SPINS = 4, 2
_REST_S = 5.0
_REPEATS = 2  # of a run
_MOST_DIFFERENCE = 0.25  # of the counted way: a typed one that differs more is mistyped
_AHEAD_M = 0.2  # more than the tag's least distance, at the end of a straight


class Wanted(Struct, frozen=True, kw_only=True):
    """The runs to drive, and the truth with which they are compared."""

    truth: Literal["tape", "tag", "gyro"] = "tape"
    length_m: float = 1.5
    straights: int = 6
    spins: int = 2
    turns: int = 3
    speed_m_s: float = 0.19  # at half power; Goob's
    tag: int = 13
    tag_size_m: float = 0.25
    family: str = FAMILY
    expected: OdometrySettings = OdometrySettings()


class Person(Protocol):
    """The person at the terminal."""

    def tell(self, line: str) -> None:
        """Show a line."""

    def ask(self, question: str) -> str:
        """Return the answer that the person types."""


class _Movement(NamedTuple):
    """The movement of a straight run: its way along the arc (reverse negative), and its counter-clockwise turn."""

    mm: float
    turn_rad: float


def calibrate(robot: Robot, person: Person, wanted: Wanted, clock: Callable[[], float] = time.monotonic) -> Calibration:
    """Drive all runs, fit the wheels, and write ``odometry.json`` beside the config. Raises PebbleError, Stopped."""
    check(wanted)
    path = robot.config.folder / CALIBRATION
    with as_owner(path.parent):
        write(path.with_suffix(".try"), b"", 0o644, PebbleError)  # raises before the runs if nothing can be written
        path.with_suffix(".try").unlink()
    session = _Session(robot, person, wanted, clock)
    result = session.run()
    calibration = Calibration(
        made=datetime.now(UTC).isoformat(timespec="seconds"),
        left_step_mm=round(result.left_step_mm, 4),
        right_step_mm=round(result.right_step_mm, 4),
        track_mm=round(result.track_mm, 3),
        truth=wanted.truth,
        runs=len(session.runs),
        residual_mm=round(result.residual_mm, 2),
    )
    with as_owner(path.parent):
        write(path, json.format(json.encode(calibration), indent=2) + b"\n", 0o644, PebbleError)
    return calibration


def check(wanted: Wanted) -> None:
    """Raise PebbleError for too few runs, or an odd number of straight ones."""
    if wanted.straights < LEAST_STRAIGHTS or wanted.spins < LEAST_SPINS:
        least = f"{LEAST_STRAIGHTS} straights and {LEAST_SPINS} spins"
        raise PebbleError(f"{least} are the least: with fewer the result is twice as wrong")
    if wanted.straights % 2:
        raise PebbleError(
            f"{wanted.straights} straights do not end where they began: an even number goes there and back"
        )


class _Session:
    """All runs of one calibration."""

    def __init__(self, robot: Robot, person: Person, wanted: Wanted, clock: Callable[[], float]) -> None:
        self._person, self._wanted = person, wanted
        self._legs = Legs(robot, wanted.expected, wanted.speed_m_s * 1000, clock)
        if wanted.truth == "tag":
            camera = CameraModel.find([robot.config.folder])
            self._legs.watch(TagFinder(wanted.tag_size_m, camera, wanted.family), wanted.tag)
        kinds = [self._straight] * wanted.straights + [self._spin] * wanted.spins
        #: The method of each run, and its sign, in turns: 1 (there, or left), -1 (back, or right). The number of
        #: straights is even (`check`): runs 0 and 1, 2 and 3, and so on, are pairs of them. So spins begin with 1, too.
        self._drives = [(drive, 1 if number % 2 == 0 else -1) for number, drive in enumerate(kinds)]
        self.runs: list[Run] = []

    def run(self) -> Fit:
        """Drive all runs and fit the wheels; repeat the run that fits worst until noise explains all residuals."""
        self._person.tell(f"It rests {_REST_S:g} s; then {self._plan()}. STOP, Space on the page or Ctrl-C end it.")
        self._legs.rest(_REST_S)
        for number in range(len(self._drives)):
            self.runs.append(self._drive(number))
        result, repeats = self._fit(), [0] * len(self.runs)
        while (worst := result.worst) is not None:
            name, off = self.runs[worst].name, f"{result.mm[worst]:.0f} mm off, {result.sigma[worst]:.1f} sigma"
            if repeats[worst] == _REPEATS:
                raise PebbleError(f"{name} stays {off}: does a wheel slip, or a magnet miss?")
            repeats[worst] += 1
            self._person.tell(f"{name} is {off}, more than {LIMIT_SIGMA:g}: it is repeated")
            first, last = worst, worst
            if self.runs[worst].mm is not None:  # a straight one: its whole pair, so that it ends where it began
                first = worst // 2 * 2  # the even number of the pair
                last = first + 1
            for number in range(first, last + 1):
                self.runs[number] = self._drive(number)
            result = self._fit()
        for run, mm, sigma in zip(self.runs, result.mm, result.sigma, strict=True):
            self._person.tell(f"  {run.name:<22} residual {mm:5.1f} mm, {sigma:.1f} sigma")
        return result

    def _plan(self) -> str:
        wanted = self._wanted
        straights = f"{wanted.straights} straights of {wanted.length_m:g} m, there and back"
        return f"{straights}, at {POWER:.0%} power, and {wanted.spins} spins of {wanted.turns} turns"

    def _fit(self) -> Fit:
        expected = self._wanted.expected
        return fit(self.runs, NOISE[self._wanted.truth], expected.step_mm, expected.track_width_mm)

    def _drive(self, number: int) -> Run:
        drive, sign = self._drives[number]
        return drive(f"{number + 1} of {len(self._drives)}", sign)

    # -- the two kinds

    def _straight(self, number: str, sign: int) -> Run:
        """Drive a straight; return the wheels' steps and the true movement, as the tag shows or the person types."""
        name = f"{number}, straight {'there' if sign > 0 else 'back'}"
        wanted, mm = self._wanted, sign * self._wanted.length_m * 1000
        if wanted.truth == "tag":
            start, least_m = self._legs.look(), wanted.length_m + NEAREST_M + _AHEAD_M
            if sign > 0 and start.distance_m < least_m:
                raise PebbleError(
                    f"the tag is {start.distance_m:.2f} m away: {least_m:.2f} m are needed, or a shorter --length"
                )
            self._person.tell(f"{name} …")
            counts = self._legs.straight(name, mm)
            moved = between(start, self._legs.look())
        else:
            self._person.ask(f"{name}: put it on the line, looking along it, and mark its axle. Enter drives: ")
            counts = self._legs.straight(name, mm)
            moved = self._typed(sign, counts)
        self._tell(name, counts, f"{moved.mm:.0f} mm, turned {math.degrees(moved.turn_rad):+.1f}°")
        return Run(name, counts.left, counts.right, moved.turn_rad, moved.mm)

    def _spin(self, number: str, sign: int) -> Run:
        """Drive a spin; return the wheels' steps and the true turn, by the tag, the gyroscope or the person."""
        name = f"{number}, spin {'left' if sign > 0 else 'right'}"
        wanted, turns = self._wanted, sign * self._wanted.turns
        start = self._legs.look() if wanted.truth == "tag" else None
        if wanted.truth == "tape":
            self._person.ask(f"{name}: mark where it looks. Enter drives: ")
        else:
            self._person.tell(f"{name} …")
        counts = self._legs.spin(name, turns)
        if wanted.truth == "gyro":
            turn_rad = self._gyro(counts)
        elif start is not None:
            turn_rad = turns * math.tau + self._legs.look().angle_rad - start.angle_rad
        else:
            question = "degrees past its mark (short of it: minus)"
            (past_deg,) = self._numbers(question, 1, lambda numbers: abs(numbers[0]) < 180)
            turn_rad = turns * math.tau + sign * math.radians(past_deg)
        self._tell(name, counts, f"turned {math.degrees(turn_rad):+.1f}°")
        return Run(name, counts.left, counts.right, turn_rad)

    def _typed(self, sign: int, counts: Counts) -> _Movement:
        """Return the movement of a straight run: its length as typed, its turn as typed or by the gyroscope."""
        left, right = self._wanted.expected.step_mm
        counted = abs(counts.left * left + counts.right * right) / 2

        def is_plausible(numbers: list[float]) -> bool:
            return abs(numbers[0] - counted) < _MOST_DIFFERENCE * counted

        what = "mm along the line"
        if self._wanted.truth == "tape":
            what += " and mm to the left of it (right: minus), such as 1497 -12"
            along, aside = self._numbers(what, 2, is_plausible)
            return arc(sign * along, aside)  # `aside` counts to the left of the heading, also when it drives back
        half_turn = self._gyro(counts) / 2  # the direction of an arc's end, from the first heading
        (along,) = self._numbers(what, 1, is_plausible)
        return arc(sign * along, sign * along * math.tan(half_turn))

    def _numbers(self, what: str, count: int, plausible: Callable[[list[float]], bool]) -> list[float]:
        """Ask for ``count`` numbers until they are plausible; return them."""
        while True:
            try:
                numbers = [float(word) for word in self._person.ask(f"    {what}: ").split()]
            except ValueError:
                numbers = []
            if len(numbers) == count and all(map(math.isfinite, numbers)) and plausible(numbers):
                return numbers
            what_to_type = "1 number" if count == 1 else f"{count} numbers"
            self._person.tell(f"    type {what_to_type} near what its wheels have counted")

    def _gyro(self, counts: Counts) -> float:
        """Return the turn by the gyroscope, in radians. Raises PebbleError without one."""
        if counts.gyro_rad is None:
            raise PebbleError("no inertial sensor that agrees with the wheels: use --truth tape or tag")
        return counts.gyro_rad

    def _tell(self, name: str, counts: Counts, moved: str) -> None:
        self._person.tell(f"{name}: {counts.left:+.1f} and {counts.right:+.1f} steps, {moved}")


def arc(along_mm: float, left_mm: float) -> _Movement:
    """Return the movement on an arc to a place, measured along and left of the first heading; backwards is negative."""
    half_turn = math.atan2(math.copysign(1.0, along_mm) * left_mm, abs(along_mm))
    return _on_arc(math.copysign(math.hypot(along_mm, left_mm), along_mm), half_turn)


def between(start: Place, end: Place) -> _Movement:
    """Return the movement of a robot that drove an arc, by the places of one tag as seen from its start and its end."""
    before_mm, before_rad = _on_floor_mm(start), start.angle_rad
    after_mm, after_rad = _on_floor_mm(end), end.angle_rad
    # Both headings differ from the chord's by half of the turn. The tag's distance beside the chord does not change, so
    # before_mm * sin(before_rad + half_turn) == after_mm * sin(after_rad - half_turn).
    half_turn = math.atan2(
        after_mm * math.sin(after_rad) - before_mm * math.sin(before_rad),
        after_mm * math.cos(after_rad) + before_mm * math.cos(before_rad),
    )
    chord_mm = before_mm * math.cos(before_rad + half_turn) - after_mm * math.cos(after_rad - half_turn)
    return _on_arc(chord_mm, half_turn)


def _on_floor_mm(place: Place) -> float:
    return math.sqrt(place.distance_m**2 - place.down_m**2) * 1000


def _on_arc(chord_mm: float, half_turn_rad: float) -> _Movement:
    ratio = half_turn_rad / math.sin(half_turn_rad) if half_turn_rad else 1.0  # of the arc to its chord
    return _Movement(chord_mm * ratio, 2 * half_turn_rad)
