"""The power that the wheels are commanded, as their owner says, for a sensor that cannot see the direction."""

from pebble.contract.payloads import MotorPower

_HOLD_S = 0.35  # wheels coast so long
_LEAST_POWER = 0.02


class Directions:
    """The power of both motors, and the direction in which each wheel may turn."""

    def __init__(self, now: float) -> None:
        self._power = (0.0, 0.0)  # left, right
        self._signs = [0, 0]
        self._signs_until = [now, now]

    def command(self, power: MotorPower, now: float) -> None:
        self._note_signs(now)
        self._power = (power.left, power.right)

    def at(self, now: float) -> tuple[tuple[float, int], tuple[float, int]]:
        """Power and possible direction of the left and the right wheel; a direction remains while wheels coast."""
        self._note_signs(now)
        left, right = (s if now <= until else 0 for s, until in zip(self._signs, self._signs_until, strict=True))
        return (self._power[0], left), (self._power[1], right)

    def _note_signs(self, now: float) -> None:
        for wheel, power in enumerate(self._power):
            if abs(power) >= _LEAST_POWER:
                self._signs[wheel] = 1 if power > 0.0 else -1
                self._signs_until[wheel] = now + _HOLD_S
