"""The state of the connection to the broker. Pure: takes events and the time, returns one action at a time."""

from micropython import const

from common.ticks import diff

_SILENCE_MS = const(2000)  # without an answer: queued commands may be as old, and are dropped with the connection
_FIRST_WAIT_MS = const(500)
_LONGEST_WAIT_MS = const(8000)
_STABLE_MS = const(5000)  # a connection lost earlier counts as a failed attempt


class Connection:
    """A state machine. Call ``step`` every turn, and ``move``, ``received`` and ``lost`` at their events.

    ``state`` is "offline" (no Wi-Fi), "waiting" (for the next attempt), "resolving" (the broker's name), "connecting"
    (TCP, TLS, CONNACK), "subscribing" (commands may arrive already) or "online".
    """

    def __init__(self) -> None:
        self.state = "offline"
        self.reason = ""  # of the last loss or failure
        self.losses = 0
        self.failures = 0  # attempts that failed, and connections lost early: the next address has its turn
        self._since = self._received = self._wait = 0
        self._next_wait = _FIRST_WAIT_MS

    def step(self, now: int, wifi: bool) -> str:
        """Return the action that is due: "resolve" the broker's name, "drop" the connection, or "" for none."""
        state = self.state
        age = diff(now, self._since)
        if not wifi:
            self.state = "offline"
            if state != "offline" and state != "waiting":
                self.reason = "no wifi"
                return "drop"
        elif state == "online":
            if age >= _STABLE_MS:
                self._next_wait = _FIRST_WAIT_MS
            if diff(now, self._received) >= _SILENCE_MS:
                self.reason = "silence"
                return "drop"
        elif state == "offline" or (state == "waiting" and age >= self._wait):
            self.move("resolving", now)
            return "resolve"
        elif state != "waiting" and age >= {"resolving": 3500, "connecting": 8000, "subscribing": 2000}[state]:
            self.reason = state + " took too long"
            return "drop"
        return ""

    def move(self, state: str, now: int) -> None:
        """Enter ``state``: the broker's address is known, or CONNACK or SUBACK was received."""
        self.state = state
        self._since = now
        self.received(now)

    def received(self, now: int) -> None:
        """Note an answer of the broker. Other bytes do not count: they may have been on their way for long."""
        self._received = now

    def lost(self, now: int, random: int) -> None:
        """Note that a connection was lost or not made; ``random`` 0..255 spreads the attempts of many robots."""
        self.losses += 1
        # a failure, unless the Wi-Fi is away, or the connection was stable, which has reset the wait
        if self.state != "offline" and (self.state != "online" or self._next_wait != _FIRST_WAIT_MS):
            self.failures += 1
        wait = self._next_wait
        self._next_wait = min(2 * wait, _LONGEST_WAIT_MS)
        self._wait = wait - (wait >> 2) + (wait * random >> 9)  # 0.75 to 1.25 of it
        if self.state != "offline":
            self.move("waiting", now)
