"""The legs of a calibration: single drives and spins, limited in way and time, whose steps are counted."""

import math
import queue
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from pebble.contract import MOTOR_POWER, TOUCH_SENSORS
from pebble.errors import PebbleError
from pebble.extensions.scripts.perception.odometry import Odometry, OdometrySettings
from pebble.extensions.scripts.script import Robot

POWER = 0.5
MOST = 1.2  # of the expected way and time of a leg
_PERIOD_S = 0.05
_REST_S = 1.0  # after a leg: wheels coast
_SAMPLES_S = 3.0  # for the first sample


class Counts(NamedTuple):
    """The steps of both wheels (reverse negative)."""

    left: float
    right: float


class Legs:
    """The robot during its calibration. ``expected``: the sizes of wheels and track to assume.

    ``mm_s`` is its speed at half power. Every leg raises PebbleError if it cannot be driven to its end, or Stopped.
    """

    def __init__(
        self,
        robot: Robot,
        expected: OdometrySettings,
        mm_s: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._robot, self._expected, self._mm_s, self._clock = robot, expected, mm_s, clock
        self._odometry = Odometry(expected, clock())
        #: Messages from the handlers' threads, with their times; :meth:`_wait` handles them on the thread that drives.
        self._inputs: queue.SimpleQueue[tuple[Callable[..., None], Any, float]] = queue.SimpleQueue()
        self._samples = 0  # of the hall sensors
        for channel, take in ((MOTOR_POWER, self._odometry.power), (TOUCH_SENSORS, self._touch)):
            robot.on(channel, lambda value, take=take, **_: self._inputs.put((take, value, clock())))

    def rest(self, seconds: float) -> None:
        """Let the robot stand. Raises PebbleError if it has no hall sensors, or if its wheels turn."""
        self._wait(_SAMPLES_S, lambda: self._samples > 0)
        if not self._samples:
            key = "services.serial_mcu_bridge.telemetry.publish_touch_sensors"
            raise PebbleError(f"no hall sensors: set {key} to true, and start the robot again")
        before = self._counts()
        self._wait(seconds)
        after = self._counts()
        if max(abs(after.left - before.left), abs(after.right - before.right)) > 1.0:
            raise PebbleError("its wheels turn although it rests: end what drives it, and begin again")

    def straight(self, name: str, mm: float) -> Counts:
        """Drive ``mm``, measured by the steps of the wheels; negative is backwards. Return the counts."""

        def ends(counts: Counts) -> bool:
            left, right = self._way_mm(counts)
            _check_way(name, max(abs(left), abs(right)), abs(mm))
            return abs(left + right) / 2 >= abs(mm)

        return self._drive(name, (0.0, math.copysign(POWER, mm)), abs(mm) / self._mm_s, ends)

    def spin(self, name: str, turns: int) -> Counts:
        """Spin ``turns`` on the spot; negative is clockwise. Return the counts."""
        way_mm = abs(turns) * math.pi * self._expected.track_width_mm  # of each wheel
        side = -math.copysign(1.0, turns)  # as drive commands have it: positive turns to the right

        def ends(counts: Counts) -> bool:
            ways = [abs(way) for way in self._way_mm(counts)]
            _check_way(name, max(ways), way_mm)
            return sum(ways) / 2 >= way_mm

        return self._drive(name, (side * POWER, 0.0), way_mm / self._mm_s, ends)

    def _drive(
        self, name: str, command: tuple[float, float], expected_s: float, ends: Callable[[Counts], bool]
    ) -> Counts:
        """Drive until ``ends`` is true for the counts since the start. Return the counts once the wheels stand."""
        robot, start = self._robot, self._counts()
        until = self._clock() + MOST * expected_s + 0.5  # motors take a moment to their speed
        try:
            while not ends(_difference(start, self._counts())):
                if self._clock() > until:
                    why = "is it slower than --speed says?"
                    raise PebbleError(f"{name}: it is not at its end after {MOST * expected_s:.1f} s: {why}")
                if not robot.drive(*command):
                    raise PebbleError(f"{name}: it is not obeyed: {robot.why_refused or 'there is no connection'}")
                self._wait(_PERIOD_S)
        finally:
            robot.stop()
        self._wait(_REST_S)
        return _difference(start, self._counts())

    def _way_mm(self, counts: Counts) -> tuple[float, float]:
        left, right = self._expected.step_mm
        return counts.left * left, counts.right * right

    def _counts(self) -> Counts:
        value, (left, right) = self._odometry.value(), self._expected.step_mm
        return Counts(value["left_mm"] / left, value["right_mm"] / right)

    def _wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Handle messages for ``seconds``, or until ``until()`` is true."""
        end = self._clock() + seconds
        while self._clock() < end and not until():
            self._robot.sleep(min(0.01, seconds))
            while not self._inputs.empty():
                take, value, at = self._inputs.get()
                take(value, at)

    def _touch(self, touch: Any, now: float) -> None:
        self._samples += 1
        self._odometry.touch(touch.value, now)


def _difference(start: Counts, end: Counts) -> Counts:
    return Counts(end.left - start.left, end.right - start.right)


def _check_way(name: str, way_mm: float, expected_mm: float) -> None:
    if way_mm > MOST * expected_mm:
        raise PebbleError(f"{name}: a wheel has turned {way_mm:.0f} of {expected_mm:.0f} mm: does the other one turn?")
