"""What the simulated MCUs measure: magnets passing hall sensors, and a battery."""

from __future__ import annotations

import math

from pebble.simulation.motion import FULL_SPEED_MM_S, WHEEL_DIAMETER_MM, RobotMotion

_MAGNETS = 10  # per wheel
_REST, _SWING = 512, 300  # a 10-bit ADC
_FULL_V, _EMPTY_V = 8.4, 6.0  # two lithium cells
_IDLE_V_PER_S, _DRIVING_V_PER_S = 0.0001, 0.002  # a full battery idles for hours and drives for 20 minutes
_CHARGING_V_PER_S = 0.002
_SAG_V = 0.15  # under full load


def hall(motion: RobotMotion) -> tuple[int, int, int]:
    """Left wheel, right wheel, and the left wheel a quarter of a wave later."""
    waves_per_mm = _MAGNETS / (math.pi * WHEEL_DIAMETER_MM)
    left, right = (math.tau * waves_per_mm * way for way in (motion.left_mm, motion.right_mm))
    return _adc(math.sin(left)), _adc(math.sin(right)), _adc(math.sin(left - math.pi / 2))


def _adc(level: float) -> int:
    return _REST + round(_SWING * level)


class Battery:
    """Its voltage falls with time and motion, sags under load and rises on the charger."""

    def __init__(self, volts: float = 8.1, *, charging: bool = False) -> None:
        self.charging = charging
        self._rest_v, self._load = volts, 0.0

    @property
    def volts(self) -> float:
        return self._rest_v - _SAG_V * self._load

    def advance(self, motion: RobotMotion, seconds: float) -> None:
        self._load = min(1.0, (abs(motion.left_mm_s) + abs(motion.right_mm_s)) / (2 * FULL_SPEED_MM_S))
        drain = _IDLE_V_PER_S + (_DRIVING_V_PER_S - _IDLE_V_PER_S) * self._load
        gain = _CHARGING_V_PER_S if self.charging else 0.0
        self._rest_v = max(_EMPTY_V, min(_FULL_V, self._rest_v + (gain - drain) * seconds))
