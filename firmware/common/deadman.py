"""The dead-man's switch: motion ends a limited time after the last command. Pure."""

from common.ticks import diff


class DeadMan:
    """A timer. Call ``feed`` at each command that moves something, ``rest`` at rest, ``expired`` every turn."""

    def __init__(self, limit_ms: int) -> None:
        self.limit_ms = limit_ms
        self.trips = 0  # how often motion outlived its commands
        self._fed = 0
        self._armed = False

    def feed(self, now: int) -> None:
        self._fed = now
        self._armed = True

    def rest(self) -> None:
        self._armed = False

    def expired(self, now: int) -> bool:
        """True, once, when the limit has passed since the last ``feed``: the motors must stop."""
        if not self._armed or diff(now, self._fed) < self.limit_ms:
            return False
        self._armed = False
        self.trips += 1
        return True
