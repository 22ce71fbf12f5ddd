"""A steady rate chosen from events at another rate, such as 10 commands a second from 15 pictures."""


class Rate:
    """A steady rate. Call ``due`` at every event; a missed turn is not made up."""

    def __init__(self, hz: float) -> None:
        self.hz = hz
        self._due = float("-inf")

    def due(self, now: float) -> bool:
        """True if the next turn is due. Turns have fixed times, which do not depend on the times of the events."""
        period = 1.0 / self.hz
        self._due = min(self._due, now + period)  # if the rate was raised
        if now < self._due:
            return False
        self._due += period
        if self._due <= now:  # turns were missed
            self._due = now + period
        return True
