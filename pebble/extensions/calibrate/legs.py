"""The legs of a calibration: single drives and spins, limited in way and time, whose steps are counted."""

import math
import queue
import time
from collections.abc import Callable
from statistics import median
from typing import Any, NamedTuple

from pebble.contract import IMU_FAST, MOTOR_POWER, TOUCH_SENSORS
from pebble.errors import PebbleError
from pebble.extensions.scripts.perception.odometry import Odometry, OdometrySettings
from pebble.extensions.scripts.perception.tags import Place, TagFinder, largest
from pebble.extensions.scripts.script import Robot

POWER = 0.5
MOST = 1.2  # of the expected way and time of a leg
NEAREST_M = 0.4  # to the tag
_SLOW_POWER = 0.12  # while a spin looks for the tag
_BEFORE_TAG = 0.87  # of a spin that ends at the tag; it sees the tag again after the rest of its last turn
_AT_TAG_RAD = math.radians(15)  # a spin that ends there has the tag in sight, which is measured at rest
_PERIOD_S = 0.05
_REST_S = 1.0  # after a leg: wheels coast; a picture that is not older shows it at rest, or almost
_SAMPLES_S = 3.0  # for the first sample
_PICTURES = 20  # of the tag, of which the median counts
_SIGHT_S = 0.75  # without the tag in any picture: it is lost
_GLANCE_S = 2.0  # at rest: a camera has shown several new pictures
_LOOK_S = 10.0  # for the next picture of it


class Counts(NamedTuple):
    """The steps of both wheels (reverse negative), and the turn by the inertial sensor, None without one."""

    left: float
    right: float
    gyro_rad: float | None


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
        self._finder: TagFinder | None = None  # None: no tag is watched
        self._tag_id = 0
        self._picture: Any = None  # the newest one that was looked at
        self._odometry = Odometry(expected, clock())
        #: Messages from the handlers' threads, with their times; :meth:`_wait` handles them on the thread that drives.
        self._inputs: queue.SimpleQueue[tuple[Callable[..., None], Any, float]] = queue.SimpleQueue()
        self._samples, self._seen_at = 0, clock()  # of the hall sensors; when the tag was last seen
        self._turned = self._heading = 0.0  # the sum of all turns, and the heading, which wraps
        for channel, take in (
            (MOTOR_POWER, self._odometry.power),
            (TOUCH_SENSORS, self._touch),
            (IMU_FAST, self._odometry.imu),
        ):
            robot.on(channel, lambda value, take=take, **_: self._inputs.put((take, value, clock())))

    def watch(self, finder: TagFinder, tag_id: int) -> None:
        """Keep this tag in sight in all straight legs, and end spins when it is ahead."""
        self._finder, self._tag_id = finder, tag_id

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
            self._check_sight(name, forward=mm > 0)
            return abs(left + right) / 2 >= abs(mm)

        self._seen_at = self._clock()
        return self._drive(name, (0.0, math.copysign(POWER, mm)), abs(mm) / self._mm_s, ends)

    def spin(self, name: str, turns: int) -> Counts:
        """Spin ``turns`` on the spot; negative is clockwise.

        With a tag, the end of the spin is slow, until the robot sees the tag where it saw it before the spin.
        """
        way_mm = abs(turns) * math.pi * self._expected.track_width_mm  # of each wheel
        side = -math.copysign(1.0, turns)  # as drive commands have it: positive turns to the right
        fast_mm = way_mm if self._finder is None else way_mm * _BEFORE_TAG

        def ends(counts: Counts) -> bool:
            ways = [abs(way) for way in self._way_mm(counts)]
            _check_way(name, max(ways), way_mm)
            return sum(ways) / 2 >= fast_mm

        start = self.look() if self._finder is not None else None
        began = self._counts()
        self._drive(name, (side * POWER, 0.0), way_mm / self._mm_s, ends)
        if start is not None:
            slow_mm_s = self._mm_s * _SLOW_POWER / POWER
            slow_s = way_mm / abs(turns) / slow_mm_s  # that a whole turn takes
            why_late = f"it does not see tag {self._tag_id} again"
            for direction in (side, -side):  # the other way if it has rolled past the tag
                self._drive(name, (direction * _SLOW_POWER, 0.0), slow_s, lambda _: self._is_at(start), why_late)
                if self._sees():
                    break
        return _difference(began, self._counts())

    def look(self) -> Place:
        """Return where the tag is, the median of 20 pictures. Raises PebbleError if it is not in sight."""
        places: list[Place] = []
        until = self._clock() + _LOOK_S
        while len(places) < _PICTURES:
            if self._clock() > until:
                raise PebbleError(
                    f"tag {self._tag_id} is not in sight: turn the robot to it, light it, and begin again"
                )
            if (place := self._sight(_REST_S)) is not None:
                places.append(place)
        return Place(*(median(values) for values in zip(*places, strict=True)))

    def _drive(
        self,
        name: str,
        command: tuple[float, float],
        expected_s: float,
        ends: Callable[[Counts], bool],
        late: str = "is it slower than --speed says?",
    ) -> Counts:
        """Drive until ``ends`` is true for the counts since the start. Return the counts once the wheels stand.

        ``late``: the reason in the error if ``ends`` is not true in time.
        """
        robot, start = self._robot, self._counts()
        until = self._clock() + MOST * expected_s + 0.5  # motors take a moment to their speed
        try:
            while not ends(_difference(start, self._counts())):
                if self._clock() > until:
                    raise PebbleError(f"{name}: it is not at its end after {MOST * expected_s:.1f} s: {late}")
                if not robot.drive(*command):
                    raise PebbleError(f"{name}: it is not obeyed: {robot.why_refused or 'there is no connection'}")
                self._wait(_PERIOD_S)
        finally:
            robot.stop()
        self._wait(_REST_S)
        return _difference(start, self._counts())

    def _check_sight(self, name: str, *, forward: bool) -> None:
        """Raise PebbleError if the tag is too near, or was seen in no picture for half a second."""
        if self._finder is None:
            return
        place, now = self._sight(), self._clock()
        if place is not None:
            self._seen_at = now
            if forward and place.distance_m < NEAREST_M:
                raise PebbleError(f"{name}: the tag is nearer than {NEAREST_M:g} m")
        elif now - self._seen_at > _SIGHT_S:
            raise PebbleError(f"{name}: it has lost tag {self._tag_id}")

    def _sees(self) -> bool:
        """True if the tag is in a picture of the robot at rest."""
        until = self._clock() + _GLANCE_S
        while self._clock() < until:
            if self._sight(_REST_S) is not None:
                return True
        return False

    def _is_at(self, start: Place) -> bool:
        place = self._sight()
        return place is not None and abs(place.angle_rad - start.angle_rad) < _AT_TAG_RAD

    def _sight(self, max_age: float = 0.3) -> Place | None:
        """Return the tag's place in a new picture, at most ``max_age`` seconds old; None without a picture or tag."""
        assert self._finder is not None  # noqa: S101 - only a calibration with a tag looks
        self._wait(0.01)
        last_picture, self._picture = self._picture, self._robot.picture(max_age)
        picture = self._picture
        if picture is None or picture is last_picture:
            return None
        tag = largest(self._finder.find(picture), self._tag_id)
        return None if tag is None else tag.place

    def _way_mm(self, counts: Counts) -> tuple[float, float]:
        left, right = self._expected.step_mm
        return counts.left * left, counts.right * right

    def _counts(self) -> Counts:
        value, (left, right) = self._odometry.value(), self._expected.step_mm
        gyro = self._turned if "heading_source" in value else None
        return Counts(value["left_mm"] / left, value["right_mm"] / right, gyro)

    def _wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Handle messages for ``seconds``, or until ``until()`` is true."""
        end = self._clock() + seconds
        while self._clock() < end and not until():
            self._robot.sleep(min(0.01, seconds))
            while not self._inputs.empty():
                take, value, at = self._inputs.get()
                take(value, at)
                heading = self._odometry.pose.heading_rad
                self._turned += math.remainder(heading - self._heading, math.tau)
                self._heading = heading

    def _touch(self, touch: Any, now: float) -> None:
        self._samples += 1
        self._odometry.touch(touch.value, now)


def _difference(start: Counts, end: Counts) -> Counts:
    gyro = None if start.gyro_rad is None or end.gyro_rad is None else end.gyro_rad - start.gyro_rad
    return Counts(end.left - start.left, end.right - start.right, gyro)


def _check_way(name: str, way_mm: float, expected_mm: float) -> None:
    if way_mm > MOST * expected_mm:
        raise PebbleError(f"{name}: a wheel has turned {way_mm:.0f} of {expected_mm:.0f} mm: does the other one turn?")
