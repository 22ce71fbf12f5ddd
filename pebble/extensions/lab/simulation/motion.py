"""The physics of a robot on two driven wheels: motion and pose, hall sensors, battery."""

import math
from collections.abc import Callable
from dataclasses import dataclass

WHEEL_DIAMETER_MM = 61.0  # Goob's geometry; Fred's is not documented
TRACK_MM = 130.5
FULL_SPEED_MM_S = 380.0  # about 120 turns a minute
_LAG_S = 0.06  # time constant of the motors
_STANDSTILL_MM_S = 0.5  # friction holds the wheels below this


@dataclass(frozen=True, slots=True)
class Pose:
    x_mm: float = 0.0
    y_mm: float = 0.0
    heading_rad: float = 0.0  # −π..π, counter-clockwise positive


@dataclass(frozen=True, slots=True)
class Wheels:
    """The true measures of the wheels, which may differ from those that a program assumes."""

    left_diameter_mm: float = WHEEL_DIAMETER_MM
    right_diameter_mm: float = WHEEL_DIAMETER_MM
    track_mm: float = TRACK_MM


#: The ground under a robot: returns the pose that it reaches on its way between two poses, as something may stop it.
Ground = Callable[[Pose, Pose], Pose]


class RobotMotion:
    """Two wheels that follow their commanded speeds with a lag, and the resulting pose.

    Where ``ground`` stops the robot, its wheels slip. Without ``ground`` nothing is in the way.
    """

    def __init__(self, pose: Pose | None = None, ground: Ground | None = None, wheels: Wheels | None = None) -> None:
        self.pose, self.ground, self.wheels = pose or Pose(), ground, wheels or Wheels()
        self.left_mm_s = self.right_mm_s = 0.0
        self.left_mm = self.right_mm = 0.0  # distance of each wheel; reverse is negative

    def place(self, pose: Pose) -> None:
        """Lift the robot and put it down at ``pose``; its wheels do not notice."""
        self.pose = pose if self.ground is None else self.ground(pose, pose)

    def advance(self, left: float, right: float, seconds: float) -> None:
        """Drive the motors at ``left`` and ``right`` (−1..1 of full speed) for ``seconds``."""
        full = FULL_SPEED_MM_S / WHEEL_DIAMETER_MM  # for each millimetre of a wheel's diameter
        self.left_mm_s, left_mm = _follow(self.left_mm_s, left * full * self.wheels.left_diameter_mm, seconds)
        self.right_mm_s, right_mm = _follow(self.right_mm_s, right * full * self.wheels.right_diameter_mm, seconds)
        self._roll(left_mm, right_mm)

    def _roll(self, left_mm: float, right_mm: float) -> None:
        """Turn the wheels by these distances, and move the robot as far as the ground lets it."""
        self.left_mm += left_mm
        self.right_mm += right_mm
        turn, ahead = (right_mm - left_mm) / self.wheels.track_mm, (left_mm + right_mm) / 2
        middle = self.pose.heading_rad + turn / 2
        end = Pose(
            self.pose.x_mm + ahead * math.cos(middle),
            self.pose.y_mm + ahead * math.sin(middle),
            math.remainder(self.pose.heading_rad + turn, math.tau),
        )
        if end != self.pose:
            self.pose = end if self.ground is None else self.ground(self.pose, end)


def _follow(speed: float, wanted: float, seconds: float) -> tuple[float, float]:
    """Return speed and distance of a wheel that approaches the speed ``wanted`` exponentially."""
    left_over = (speed - wanted) * math.exp(-seconds / _LAG_S)
    way = wanted * seconds + (speed - wanted - left_over) * _LAG_S
    reached = wanted + left_over
    return (0.0 if wanted == 0.0 and abs(reached) < _STANDSTILL_MM_S else reached), way


_MAGNETS = 10  # per wheel, north and south poles in turn
_REST, _SWING = 0.5, 0.29  # of the ADC's range
# a lithium cell
_FULL_V, _START_V, _EMPTY_V = 4.2, 4.05, 3.0
_IDLE_V_PER_S, _DRIVING_V_PER_S = 0.00005, 0.001  # a full battery idles for hours and drives for 20 minutes
_CHARGING_V_PER_S = 0.001
_SAG_V = 0.075  # under full load


def hall(motion: RobotMotion) -> tuple[float, float, float]:
    """Return the Hall sensors' readings, 0..1 of the ADC's range: left, right, left a quarter wave later."""
    left = _MAGNETS * motion.left_mm / motion.wheels.left_diameter_mm  # half the magnets are waves of a turn, in rad
    right = _MAGNETS * motion.right_mm / motion.wheels.right_diameter_mm
    return _part(math.sin(left)), _part(math.sin(right)), _part(math.sin(left - math.pi / 2))


def _part(level: float) -> float:
    return _REST + _SWING * level


class Battery:
    """A battery of ``cells`` in series: falls with time and motion, sags under load, rises on the charger."""

    def __init__(self, cells: int) -> None:
        self.charging = False
        self._cells = cells
        self._rest_v, self._load = _START_V, 0.0  # of one cell

    @property
    def volts(self) -> float:
        return (self._rest_v - _SAG_V * self._load) * self._cells

    def advance(self, motion: RobotMotion, seconds: float) -> None:
        self._load = min(1.0, (abs(motion.left_mm_s) + abs(motion.right_mm_s)) / (2 * FULL_SPEED_MM_S))
        drain = _IDLE_V_PER_S + (_DRIVING_V_PER_S - _IDLE_V_PER_S) * self._load
        gain = _CHARGING_V_PER_S if self.charging else 0.0
        self._rest_v = max(_EMPTY_V, min(_FULL_V, self._rest_v + (gain - drain) * seconds))
