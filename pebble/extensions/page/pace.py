"""A limit on the work that one page can cause at the server; a page beyond it is read more slowly. Pure."""

PER_S = 100.0  # a page that drives sends 25 messages a second
BURST = 200.0
STOP_WAITS_S = 0.05  # a stop at most, however much was sent


class Pace:
    """A token bucket of BURST tokens that refills by PER_S a second."""

    def __init__(self, now: float) -> None:
        self._left, self._at = BURST, now

    def take(self, cost: float, now: float) -> float:
        """Take ``cost`` tokens; return how many seconds to wait before the request is handled."""
        self._left = min(BURST, self._left + PER_S * (now - self._at)) - cost
        self._at = now
        return max(0.0, -self._left / PER_S)
