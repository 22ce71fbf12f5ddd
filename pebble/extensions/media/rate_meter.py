"""A meter of messages and bits per second, and of the age of messages. Pure: times are passed in."""

import statistics
from collections import deque
from typing import Final, NamedTuple

WINDOW_S: Final = 3.0
_LIMIT: Final = 1000  # messages of the last seconds that are counted


class Arrival(NamedTuple):
    at: float  # monotonic seconds
    size: int  # bytes of payload
    age_s: float | None  # since capture, if known; needs both clocks to agree


class RateMeter:
    """A meter of the newest messages: up to ``limit`` of them, none older than ``window_s``.

    A rate is the number of messages after the first, divided by the time from the first to the last. One thread may add
    while others read.
    """

    def __init__(self, window_s: float = WINDOW_S, limit: int = _LIMIT) -> None:
        self.count = 0  # of all messages ever added
        self._window_s = window_s
        self._arrivals: deque[Arrival] = deque(maxlen=limit)

    def add(self, now: float, size: int = 0, age_s: float | None = None) -> None:
        self.count += 1
        self._arrivals.append(Arrival(now, size, age_s))

    def clear(self) -> None:
        """Begin a new window."""
        self._arrivals.clear()

    def rate(self, now: float) -> float:
        """Return the messages per second; 0 before the second message."""
        recent, seconds = self._recent(now)
        return (len(recent) - 1) / seconds if seconds > 0 else 0.0

    def bitrate(self, now: float) -> float:
        """Return the bits of payload per second."""
        recent, seconds = self._recent(now)
        return 8 * sum(arrival.size for arrival in recent[1:]) / seconds if seconds > 0 else 0.0

    def age_s(self, now: float) -> float | None:
        """Return the median age of the messages; None if no message has a time stamp."""
        ages = [arrival.age_s for arrival in self._recent(now)[0] if arrival.age_s is not None]
        return statistics.median(ages) if ages else None

    def arrivals(self, now: float) -> list[Arrival]:
        """Return the messages in the window, oldest first."""
        return self._recent(now)[0]

    def _recent(self, now: float) -> tuple[list[Arrival], float]:
        """Return the messages in the window, and the seconds from the first to the last."""
        copied = list(self._arrivals)  # another thread may add meanwhile
        recent = [arrival for arrival in copied if now - arrival.at <= self._window_s]
        return recent, recent[-1].at - recent[0].at if recent else 0.0
