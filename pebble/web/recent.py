"""What components sent in the last minutes of what pages plot, for pages that open a plot later. Pure.

Values are thinned to a rate; what is too old, too long or too much is left out.
"""

import math
from collections import deque
from typing import Final, NamedTuple

import msgspec

from pebble.contract import CHARGING_LEVEL, IMU, TOUCH_SENSORS, WHEEL_ODOMETRY
from pebble.transports import Message

MAX_VALUE_BYTES: Final = 2048  # longer ones are not plotted
MAX_BYTES: Final = 64 << 20  # of all components together
MESSAGE_BYTES: Final = 32 * 1024  # of one metric for one page: a second on a connection of 256 kbit/s
_OVERHEAD: Final = 150  # bytes that one value takes besides its own

Point = tuple[float, msgspec.Raw]


class _Limits(NamedTuple):
    seconds: float
    rate_hz: float
    most_bytes: int
    always: bool = False  # also while no page has the component open


LIMITS: Final = {
    CHARGING_LEVEL.metric: _Limits(600, 0.5, 64 << 10, always=True),
    WHEEL_ODOMETRY.metric: _Limits(120, 10, 1 << 20),
    IMU.metric: _Limits(120, 10, 1 << 20),
    TOUCH_SENSORS.metric: _Limits(120, 20, 1 << 20),
}


class Recent:
    """The newest values of all components. Only the event loop calls it."""

    def __init__(self) -> None:
        self.bytes = 0
        self._open: set[str] = set()
        self._rings: dict[tuple[str, str], _Ring] = {}

    def open(self, ref: str) -> None:
        self._open.add(ref)

    def close(self, ref: str) -> None:
        """No page has it open any more."""
        self._open.discard(ref)
        for metric, limits in LIMITS.items():
            if not limits.always:
                self._remove(ref, metric)

    def forget(self, ref: str) -> None:
        for metric in LIMITS:
            self._remove(ref, metric)

    def receive(self, ref: str, metric: str, message: Message, now: float) -> None:
        """Take a value. How old a retained one is, is not known."""
        limits = LIMITS.get(metric)
        if limits is None or message.retain or len(message.payload) > MAX_VALUE_BYTES:
            return
        if not (limits.always or ref in self._open):
            return
        ring = self._rings.get((ref, metric))
        if ring is None:
            ring = self._rings[ref, metric] = _Ring(limits)
        before = ring.bytes
        ring.drop(now)
        if self.bytes + ring.bytes - before + len(message.payload) + _OVERHEAD <= MAX_BYTES:
            ring.add(message.payload, now)
        self.bytes += ring.bytes - before

    def metrics(self, ref: str) -> list[str]:
        return [metric for metric in LIMITS if (ref, metric) in self._rings]

    def points(self, ref: str, metric: str, now: float) -> tuple[Point, ...]:
        """Age in ms and value, oldest first: evenly thinned, so that they fit into one message."""
        ring = self._rings.get((ref, metric))
        if ring is None:
            return ()
        before = ring.bytes
        ring.drop(now)
        self.bytes += ring.bytes - before
        newest_first = [(round(1000 * (now - at), 1), value) for at, value in reversed(ring.points)]
        step = max(1, math.ceil(_length(newest_first) / MESSAGE_BYTES))
        while _length(newest_first[::step]) > MESSAGE_BYTES:
            step += 1
        return tuple(reversed(newest_first[::step]))

    def _remove(self, ref: str, metric: str) -> None:
        ring = self._rings.pop((ref, metric), None)
        if ring is not None:
            self.bytes -= ring.bytes


class _Ring:
    """One metric of one component."""

    def __init__(self, limits: _Limits) -> None:
        self.points: deque[Point] = deque()  # monotonic seconds, and the payload
        self.bytes = 0
        self._limits = limits
        self._due = float("-inf")

    def add(self, payload: bytes, now: float) -> None:
        if now < self._due:
            return
        every = 1 / self._limits.rate_hz
        self._due = max(self._due + every, now)  # on average not more, though values do not arrive in step with it
        self.points.append((now, msgspec.Raw(payload)))
        self.bytes += len(payload) + _OVERHEAD
        while self.bytes > self._limits.most_bytes:
            self._drop_oldest()

    def drop(self, now: float) -> None:
        """What is too old."""
        while self.points and self.points[0][0] < now - self._limits.seconds:
            self._drop_oldest()

    def _drop_oldest(self) -> None:
        _, value = self.points.popleft()
        self.bytes -= len(bytes(value)) + _OVERHEAD


def _length(points: list[Point]) -> int:
    """About as many bytes as JSON."""
    return sum(len(bytes(value)) + 12 for _, value in points)
