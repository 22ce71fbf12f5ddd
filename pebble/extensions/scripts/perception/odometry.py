"""The pose of a robot by its wheels' hall sensors and the power of its motors: dead reckoning from (0, 0, 0).

Commands and samples are processed in the order of their arrival, because samples carry no time. Distances are good to
millimetres as long as no wheel slips; heading is good to the difference of both wheels' calibration, and better with
an inertial sensor.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

from msgspec import Meta, Struct
from msgspec.structs import replace

from pebble.contract.payloads import ImuFast, MotorPower, TouchValues
from pebble.extensions.scripts.perception.gyro import GyroHeading
from pebble.extensions.scripts.perception.hall import HallSample, HallWheel

_MOVING_S = 0.45  # a robot counts as moving so long after its last motion
_STALL_S = 0.32
_NOISE_MM = 1.0  # less is no motion
_UNCHANGED_S = 0.3  # without motion and power the robot is at rest
_HOLD_S = 0.35  # wheels coast so long
_LEAST_POWER = 0.02


CALIBRATION = "odometry.json"  # in the config's folder

Pin = Literal["a0", "a1", "a2"]
Length = Annotated[float, Meta(gt=0, le=5000)]


class Calibration(Struct, frozen=True, kw_only=True):
    """The wheels as `pebble calibrate wheels` has measured them: the content of ``odometry.json``."""

    version: Literal[1] = 1
    made: str  # date and time
    counts: Literal["once"] = "once"  # a step is counted once; the original's tuning program counts it twice
    left_step_mm: Length
    right_step_mm: Length
    track_mm: Length
    truth: str
    runs: int
    residual_mm: float


class OdometrySettings(Struct, frozen=True, kw_only=True):
    """Wheels, magnets of alternating poles, and the ADC channels of their sensors."""

    use_tune_state: Annotated[bool, Meta(title="Use Tune State")] = False
    wheel_diameter_mm: Annotated[float, Meta(ge=1, le=1000, title="Wheel Diameter (mm)")] = 61.0
    track_width_mm: Annotated[float, Meta(ge=1, le=5000, title="Track Width (mm)")] = 130.5
    magnets: Annotated[int, Meta(ge=1, le=200, title="Magnets per Wheel")] = 10
    left_channel: Annotated[Pin, Meta(title="Left Sensor")] = "a0"
    right_channel: Annotated[Pin, Meta(title="Right Sensor")] = "a1"
    second_channel: Annotated[
        Literal["a0", "a1", "a2", "none"], Meta(title="Second Left Sensor, a quarter wave away")
    ] = "a2"
    left_mm_per_event: Annotated[float, Meta(ge=0, le=1000, title="Left Step (mm), 0: by geometry")] = 0.0
    right_mm_per_event: Annotated[float, Meta(ge=0, le=1000, title="Right Step (mm), 0: by geometry")] = 0.0
    publish_rate_hz: Annotated[float, Meta(ge=1, le=50, title="Rate While Moving (Hz)")] = 20.0
    idle_publish_rate_hz: Annotated[float, Meta(ge=0.2, le=50, title="Rate at Rest (Hz)")] = 2.0

    @property
    def step_mm(self) -> tuple[float, float]:
        """Return the length of a step of the left and of the right wheel; a step is one magnet."""
        step = math.pi * self.wheel_diameter_mm / self.magnets
        return self.left_mm_per_event or step, self.right_mm_per_event or step


def calibrated(settings: OdometrySettings, calibration: Calibration) -> OdometrySettings:
    """Return the settings with the measured values, but keep each value that the user has changed from its default."""
    default = OdometrySettings()
    if settings.step_mm == default.step_mm:
        steps = {"left_mm_per_event": calibration.left_step_mm, "right_mm_per_event": calibration.right_step_mm}
        settings = replace(settings, **steps)
    if settings.track_width_mm == default.track_width_mm:
        settings = replace(settings, track_width_mm=calibration.track_mm)
    return settings


class WheelPose(NamedTuple):
    """A pose in the frame of the start: x ahead, y to the left, heading −π..π, counter-clockwise positive."""

    x_mm: float = 0.0
    y_mm: float = 0.0
    heading_rad: float = 0.0


@dataclass(slots=True)
class _Part:
    """An arc of the way: that of the newest sample, or of all samples whose distances may still be corrected."""

    ahead_mm: float = 0.0
    turn_rad: float = 0.0

    def end(self, start: WheelPose) -> WheelPose:
        """Return the pose at the end of the arc."""
        half = self.turn_rad / 2
        chord = self.ahead_mm * (math.sin(half) / half if half else 1.0)
        middle = start.heading_rad + half
        return WheelPose(
            start.x_mm + chord * math.cos(middle),
            start.y_mm + chord * math.sin(middle),
            math.remainder(start.heading_rad + self.turn_rad, math.tau),
        )


class _Wheel:
    """A wheel, with the time when it last turned, and the number of times it has stalled."""

    def __init__(self, mm_per_step: float) -> None:
        self.hall = HallWheel(mm_per_step)
        self.turned_at = float("-inf")
        self.stalls = 0
        self._turned_mm = 0.0  # its distance when it last turned
        self._blocked_since: float | None = None  # it has power and does not turn; inf: counted as a stall already

    def update(self, sample: HallSample, now: float) -> float:
        """Return the distance since the last sample, in mm; note whether the wheel turns, and count a stall once."""
        distance = self.hall.update(sample)
        has_turned = abs(self.hall.mm - self._turned_mm) > _NOISE_MM
        if has_turned:
            self._turned_mm, self.turned_at = self.hall.mm, now
        if has_turned or not sample.power:
            self._blocked_since = None
        elif self._blocked_since is None:
            self._blocked_since = now
        elif now - self._blocked_since > _STALL_S:
            self.stalls += 1
            self._blocked_since = math.inf
        return distance


class Motor(NamedTuple):
    """The power of a motor, and the direction in which its wheel may turn: 1, −1, or 0 if it is unknown."""

    power: float
    direction: int


class Directions:
    """The power of both motors, and the direction in which each wheel may turn. One hall sensor does not show it."""

    def __init__(self, now: float) -> None:
        self._power = (0.0, 0.0)  # left and right, as the next two
        self._directions = [0, 0]
        self._known_until = [now, now]

    def command(self, power: MotorPower, now: float) -> None:
        self._note_directions(now)
        self._power = (power.left, power.right)

    def at(self, now: float) -> tuple[Motor, Motor]:
        """Return the left and the right motor. A coasting wheel keeps its direction for a while."""
        self._note_directions(now)
        known = [direction if now <= self._known_until[side] else 0 for side, direction in enumerate(self._directions)]
        return Motor(self._power[0], known[0]), Motor(self._power[1], known[1])

    def _note_directions(self, now: float) -> None:
        for side, power in enumerate(self._power):
            if abs(power) >= _LEAST_POWER:
                self._directions[side] = 1 if power > 0.0 else -1
                self._known_until[side] = now + _HOLD_S


class Odometry:
    """The odometry of one robot. Pass it every power that the wheels are commanded, and every sample."""

    def __init__(self, settings: OdometrySettings, now: float) -> None:
        self.pose = self._base = WheelPose()  # the base: where the present part begins
        self.distance_mm = 0.0
        self._part = _Part()  # the way since the base
        self._was_ready = True  # at the last sample no sensor was in its warm-up, which may correct the part
        self._settings = settings
        self._directions = Directions(now)
        self._left, self._right = map(_Wheel, settings.step_mm)
        self._gyro = GyroHeading()
        self._heading_source = "wheels"  # of the newest turn; else "gyro"
        self._samples = self._published = 0  # samples of the hall sensors, and calls of :meth:`value`
        self._powered = False  # a motor had power at the newest sample

    def moving(self, now: float) -> bool:
        return now - max(self._left.turned_at, self._right.turned_at) < _MOVING_S

    def power(self, power: MotorPower, now: float) -> None:
        self._directions.command(power, now)

    def imu(self, imu: ImuFast, now: float) -> None:
        """Add a sample of the inertial sensor."""
        still_s = now - max(self._left.turned_at, self._right.turned_at)
        at_rest = still_s > _UNCHANGED_S and not self._powered
        self._gyro.sample(imu.value.gyro_dps.z, imu.mcu_ms, now, at_rest=at_rest)

    def touch(self, values: TouchValues, now: float) -> None:
        """Add a sample of the hall sensors."""
        self._samples += 1
        settings, (left, right) = self._settings, self._directions.at(now)
        # Only the left wheel may have a second sensor.
        left_second = None if settings.second_channel == "none" else getattr(values, settings.second_channel)
        left_value, right_value = getattr(values, settings.left_channel), getattr(values, settings.right_channel)
        left_mm = self._left.update(HallSample(left_value, left_second, left.power, left.direction), now)
        right_mm = self._right.update(HallSample(right_value, None, right.power, right.direction), now)  # one sensor
        self._powered = left.power != 0.0 or right.power != 0.0
        self._move(left_mm, right_mm, now)

    def _move(self, left_mm: float, right_mm: float, now: float) -> None:
        """Add the distances of both wheels to the pose."""
        turn = (right_mm - left_mm) / self._settings.track_width_mm
        measured = self._gyro.take(turn, now)
        self._heading_source = "wheels" if measured is None else "gyro"
        part = self._part
        part.ahead_mm += (left_mm + right_mm) / 2
        part.turn_rad += turn if measured is None else measured
        self.pose = part.end(self._base)
        is_ready = self._left.hall.ready and self._right.hall.ready
        if is_ready:  # no sensor is warming up, which could still correct the part: it is complete
            if self.moving(now) or not self._was_ready:  # at rest, motion is noise; but a warm-up's part counts
                self.distance_mm += abs(part.ahead_mm)
            self._base, self._part = self.pose, _Part()
        self._was_ready = is_ready

    def value(self) -> dict[str, Any]:
        """Return the ``value`` of the payload (paper A.8.12), each time with the next ``publish_seq``."""
        self._published += 1
        left, right = self._left.hall, self._right.hall
        value: dict[str, Any] = {
            "x_mm": round(self.pose.x_mm, 3),
            "y_mm": round(self.pose.y_mm, 3),
            "heading_rad": round(self.pose.heading_rad, 6),
            "heading_deg": round(math.degrees(self.pose.heading_rad), 3),
            "left_mm": round(left.mm, 3),
            "right_mm": round(right.mm, 3),
            "distance_mm": round(self.distance_mm, 3),
            "left_crossings": int(left.steps),
            "right_crossings": int(right.steps),
            "unknown_direction_events": left.unknown + right.unknown,
            "left_step_total": round(left.steps, 6),
            "right_step_total": round(right.steps, 6),
            "left_mm_per_step": round(left.mm_per_step, 6),
            "right_mm_per_step": round(right.mm_per_step, 6),
            "left_extrema_events": left.extrema,
            "right_extrema_events": right.extrema,
            "left_rejected_sign_flips": left.rejected,
            "right_rejected_sign_flips": right.rejected,
            "left_stall_events": self._left.stalls,
            "right_stall_events": self._right.stalls,
            "sample_seq": self._samples,
            "publish_seq": self._published,
        }
        if self._heading_source == "gyro":
            value["heading_source"] = "gyro"
        return value
