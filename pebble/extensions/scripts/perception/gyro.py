"""Heading by the inertial sensor: its rate about the vertical axis without its bias, while that is plausible."""

import logging
import math

log = logging.getLogger(__name__)

_FRESH_S = 0.3
_GAP_MS = 100  # samples farther apart are not integrated over
_LIMIT_DPS = 320.0  # the sensor's protocol ends at 327
_BIAS_WEIGHT = 0.005  # of a sample at rest; at 100 Hz the bias follows within 2 s
_TEST_TURN_RAD = math.pi  # so far the wheels turn the robot before the sensor is judged
_NOISE_RAD = 0.01  # per sample of the wheels: less may be noise of their sensors, and judges nothing
_LEAST_RATIO, _MOST_RATIO = 0.5, 2.0  # sensor to wheels; else it is mounted otherwise than flat, x ahead, z up


class GyroHeading:
    """The turns measured by an inertial sensor that lies flat; + is counter-clockwise."""

    def __init__(self) -> None:
        self._turn_rad = 0.0  # since the last call of :meth:`take`
        self._bias_dps = 0.0
        self._samples_at_rest = 0
        self._mcu_ms: int | None = None  # of the newest sample, by the board's clock
        self._at = float("-inf")  # when it came
        self._limited = False  # a turn since the last call of :meth:`take` was too fast for the sensor
        # Sums since the sensor was last judged: of its turns, negative where they are against those of the wheels, and
        # of the wheels' turns without their signs.
        self._agreed_rad = self._compared_rad = 0.0
        self._trusted = True  # until it contradicts the wheels; then never again

    def sample(self, z_dps: float, mcu_ms: int, now: float, *, at_rest: bool) -> None:
        """Add a sample; ``at_rest``: no wheel turns, so it shows the bias."""
        gap_ms = 0 if self._mcu_ms is None else mcu_ms - self._mcu_ms
        self._mcu_ms, self._at = mcu_ms, now
        if at_rest:
            self._samples_at_rest += 1
            self._bias_dps += max(_BIAS_WEIGHT, 1.0 / self._samples_at_rest) * (z_dps - self._bias_dps)
        elif 0 < gap_ms <= _GAP_MS:
            self._turn_rad += math.radians(z_dps - self._bias_dps) * gap_ms / 1000
            self._limited = self._limited or abs(z_dps) >= _LIMIT_DPS

    def take(self, wheels_rad: float, now: float) -> float | None:
        """Return the turn since the last call; None if ``wheels_rad``, the turn by the wheels, must be used."""
        turn, self._turn_rad = self._turn_rad, 0.0
        limited, self._limited = self._limited, False
        if now - self._at > _FRESH_S or limited or not self._trusted:
            return None
        self._compare(turn, wheels_rad)
        return turn

    def _compare(self, turn: float, wheels_rad: float) -> None:
        """Judge the sensor by the wheels, each time that they have turned the robot far enough."""
        if abs(wheels_rad) < _NOISE_RAD:
            return
        self._agreed_rad += math.copysign(1.0, wheels_rad) * turn
        self._compared_rad += abs(wheels_rad)
        if self._compared_rad < _TEST_TURN_RAD:
            return
        ratio = self._agreed_rad / self._compared_rad
        if not _LEAST_RATIO <= ratio <= _MOST_RATIO:
            log.warning("the inertial sensor shows %.0f %% of the wheels' turns: heading from the wheels", 100 * ratio)
            self._trusted = False
        self._agreed_rad = self._compared_rad = 0.0
