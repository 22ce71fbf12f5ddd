"""What the simulated MCUs measure: magnets passing hall sensors, and a battery."""

from __future__ import annotations

import math

from pebble.simulation.motion import FULL_SPEED_MM_S, WHEEL_DIAMETER_MM, RobotMotion

_MAGNETS = 10  # per wheel
_REST, _SWING = 0.5, 0.29  # of the ADC's range
# a lithium cell
_FULL_V, _START_V, _EMPTY_V = 4.2, 4.05, 3.0
_IDLE_V_PER_S, _DRIVING_V_PER_S = 0.00005, 0.001  # a full battery idles for hours and drives for 20 minutes
_CHARGING_V_PER_S = 0.001
_SAG_V = 0.075  # under full load


def hall(motion: RobotMotion) -> tuple[float, float, float]:
    """Left wheel, right wheel, and the left wheel a quarter of a wave later, as parts 0..1 of what an ADC measures."""
    waves_per_mm = _MAGNETS / (math.pi * WHEEL_DIAMETER_MM)
    left, right = (math.tau * waves_per_mm * way for way in (motion.left_mm, motion.right_mm))
    return _part(math.sin(left)), _part(math.sin(right)), _part(math.sin(left - math.pi / 2))


def _part(level: float) -> float:
    return _REST + _SWING * level


class Battery:
    """``cells`` in series. Its voltage falls with time and motion, sags under load and rises on the charger."""

    def __init__(self, cells: int = 2, *, charging: bool = False) -> None:
        self.charging = charging
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
