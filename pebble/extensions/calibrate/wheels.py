"""Calibrates the wheels: straight runs there and back, spins, and a file that wheel odometry uses."""

import math
import time
from collections.abc import Callable
from datetime import UTC, datetime
from typing import NamedTuple

import typer
from msgspec import Struct, json

from pebble.errors import PebbleError
from pebble.extensions.calibrate.fit import LIMIT_SIGMA, Fit, Run, fit
from pebble.extensions.calibrate.legs import POWER, Counts, Legs
from pebble.extensions.scripts.perception.odometry import CALIBRATION, Calibration, OdometrySettings
from pebble.extensions.scripts.script import Robot
from pebble.runtime.whole_file import write

LEAST_STRAIGHTS, LEAST_SPINS = 4, 2
_REST_S = 5.0
_REPEATS = 2  # of a run
_MOST_DIFFERENCE = 0.25  # of the counted way: a typed one that differs more is mistyped


class Wanted(Struct, frozen=True, kw_only=True):
    """The runs to drive, which a person measures with a tape."""

    length_m: float = 1.5
    straights: int = 6
    spins: int = 2
    turns: int = 3
    speed_m_s: float = 0.19  # at half power; Goob's
    expected: OdometrySettings = OdometrySettings()


class Person:
    """The person at the terminal."""

    def tell(self, line: str) -> None:
        typer.echo(line)

    def ask(self, question: str) -> str:
        """Return the answer that the person types. Raises PebbleError if there is no terminal."""
        try:
            return input(question)
        except EOFError:
            raise PebbleError("a person has to answer: run it in a terminal") from None


class _Movement(NamedTuple):
    """The movement of a straight run: its way along the arc (reverse negative), and its counter-clockwise turn."""

    mm: float
    turn_rad: float


def calibrate(robot: Robot, person: Person, wanted: Wanted, clock: Callable[[], float] = time.monotonic) -> Calibration:
    """Drive all runs, fit the wheels, and write ``odometry.json`` beside the config. Raises PebbleError, Stopped."""
    check(wanted)
    path = robot.config.folder / CALIBRATION
    write(path.with_suffix(".try"), b"", 0o644, PebbleError)  # raises before the runs if nothing can be written there
    path.with_suffix(".try").unlink()
    session = _Session(robot, person, wanted, clock)
    result = session.run()
    calibration = Calibration(
        made=datetime.now(UTC).isoformat(timespec="seconds"),
        left_step_mm=round(result.left_step_mm, 4),
        right_step_mm=round(result.right_step_mm, 4),
        track_mm=round(result.track_mm, 3),
        truth="tape",
        runs=len(session.runs),
        residual_mm=round(result.residual_mm, 2),
    )
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
        return fit(self.runs, expected.step_mm, expected.track_width_mm)

    def _drive(self, number: int) -> Run:
        drive, sign = self._drives[number]
        return drive(f"{number + 1} of {len(self._drives)}", sign)

    # -- the two kinds

    def _straight(self, number: str, sign: int) -> Run:
        """Drive a straight; return the wheels' steps and the true movement, as the person types it."""
        name = f"{number}, straight {'there' if sign > 0 else 'back'}"
        self._person.ask(f"{name}: put it on the line, looking along it, and mark its axle. Enter drives: ")
        counts = self._legs.straight(name, sign * self._wanted.length_m * 1000)
        left, right = self._wanted.expected.step_mm
        counted = abs(counts.left * left + counts.right * right) / 2

        def is_plausible(numbers: list[float]) -> bool:
            return abs(numbers[0] - counted) < _MOST_DIFFERENCE * counted

        what = "mm along the line and mm to the left of it (right: minus), such as 1497 -12"
        along, aside = self._numbers(what, 2, is_plausible)
        moved = arc(sign * along, aside)  # `aside` counts to the left of the heading, also when it drives back
        self._tell(name, counts, f"{moved.mm:.0f} mm, turned {math.degrees(moved.turn_rad):+.1f}°")
        return Run(name, counts.left, counts.right, moved.turn_rad, moved.mm)

    def _spin(self, number: str, sign: int) -> Run:
        """Drive a spin; return the wheels' steps and the true turn, as the person types it."""
        name = f"{number}, spin {'left' if sign > 0 else 'right'}"
        turns = sign * self._wanted.turns
        self._person.ask(f"{name}: mark where it looks. Enter drives: ")
        counts = self._legs.spin(name, turns)
        question = "degrees past its mark (short of it: minus)"
        (past_deg,) = self._numbers(question, 1, lambda numbers: abs(numbers[0]) < 180)
        turn_rad = turns * math.tau + sign * math.radians(past_deg)
        self._tell(name, counts, f"turned {math.degrees(turn_rad):+.1f}°")
        return Run(name, counts.left, counts.right, turn_rad)

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

    def _tell(self, name: str, counts: Counts, moved: str) -> None:
        self._person.tell(f"{name}: {counts.left:+.1f} and {counts.right:+.1f} steps, {moved}")


def arc(along_mm: float, left_mm: float) -> _Movement:
    """Return the movement on an arc to a place, measured along and left of the first heading; backwards is negative."""
    half_turn = math.atan2(math.copysign(1.0, along_mm) * left_mm, abs(along_mm))
    chord_mm = math.copysign(math.hypot(along_mm, left_mm), along_mm)
    ratio = half_turn / math.sin(half_turn) if half_turn else 1.0  # of the arc to its chord
    return _Movement(chord_mm * ratio, 2 * half_turn)
