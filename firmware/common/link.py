"""What to do next to be and to stay connected to the broker. Pure: events and the time in, one action at a time out."""

from micropython import const

from common.ticks import diff

_LIMITS_MS = {"resolving": 3500, "connecting": 8000, "subscribing": 2000}
_SILENCE_MS = const(2000)  # without an answer: commands that wait may be as old, and die with the connection
_FIRST_WAIT_MS = const(500)
_LONGEST_WAIT_MS = const(8000)
_STABLE_MS = const(5000)  # a connection lost earlier counts as a failed attempt


class Link:
    """``step`` every turn; ``move``, ``heard`` and ``lost`` when it happens.

    Its ``state`` is "offline" (no Wi-Fi), "waiting" (for the next attempt), "resolving" (the broker's name),
    "connecting" (TCP, TLS, the broker's greeting), "subscribing" (commands may come already) or "online".
    """

    def __init__(self) -> None:
        self.state = "offline"
        self.reason = ""  # why the last connection was lost or not made
        self.losses = 0
        self._since = self._heard = self._wait = 0
        self._next_wait = _FIRST_WAIT_MS

    def step(self, now: int, wifi: bool) -> str:
        """What is due: "resolve" the broker's name, "drop" whatever is open; "": nothing."""
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
            if diff(now, self._heard) >= _SILENCE_MS:
                self.reason = "silence"
                return "drop"
        elif state == "offline" or (state == "waiting" and age >= self._wait):
            self.move("resolving", now)
            return "resolve"
        elif state != "waiting" and age >= _LIMITS_MS[state]:
            self.reason = state + " took too long"
            return "drop"
        return ""

    def move(self, state: str, now: int) -> None:
        """Further on: the address is known, the broker has greeted, has subscribed us."""
        self.state = state
        self._since = now
        self.heard(now)

    def heard(self, now: int) -> None:
        """The broker answered. Other bytes do not count: how long they were on their way, they do not say."""
        self._heard = now

    def lost(self, now: int, noise: int) -> None:
        """Not, or no longer, connected; ``noise`` 0..255 spreads the next attempts of many robots."""
        self.losses += 1
        wait = self._next_wait
        self._next_wait = min(2 * wait, _LONGEST_WAIT_MS)
        self._wait = wait - (wait >> 2) + (wait * noise >> 9)  # 0.75 to 1.25 of it
        if self.state != "offline":
            self.move("waiting", now)
