"""The present position in a recording that is played at a certain speed. Pure: the clock is passed in."""

from collections.abc import Callable

SLOWEST, FASTEST = 0.1, 100.0


class Pace:
    """A speed and a starting point. Positions are in nanoseconds since 1970; ``now``, in seconds, never goes back."""

    def __init__(self, now: Callable[[], float], *, speed: float) -> None:
        self._now = now
        self._speed = min(max(speed, SLOWEST), FASTEST)
        self.from_ns, self._since_s = 0, 0.0  # a position, and when playing went on from it

    @property
    def speed(self) -> float:
        return self._speed

    def change(self, speed: float, position_ns: int) -> None:
        """Play at another speed, from this position."""
        self.go_on_from(position_ns)
        self._speed = min(max(speed, SLOWEST), FASTEST)

    def go_on_from(self, position_ns: int) -> None:
        self.from_ns, self._since_s = position_ns, self._now()

    @property
    def reached_ns(self) -> int:
        """Return the present position, if nothing delays it."""
        return self.from_ns + int((self._now() - self._since_s) * self._speed * 1e9)

    def due_s(self, position_ns: int, now: float) -> float:
        """Return the seconds until a position is reached; negative if it is passed."""
        return (position_ns - self.from_ns) / 1e9 / self._speed + self._since_s - now
