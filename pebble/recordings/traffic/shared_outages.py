"""Which outages several robots had at the same moment: the network's or the recorder's, not a robot's. Pure."""

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from typing import Final

from msgspec import Struct

_WITHIN_NS: Final = 500_000_000  # of each other begin outages with one cause, or within the time between heartbeats
_LEAST: Final = 2  # robots


class Presence(Struct):
    """When heartbeats of one robot came, and when they did not."""

    interval_ns: float  # between heartbeats, usually
    online: Sequence[tuple[int, int]]  # ns, in order
    outages: Sequence[int]  # their beginnings in ns, in order

    def has_one_near(self, moment_ns: int, within_ns: float) -> bool:
        at = bisect_left(self.outages, moment_ns - within_ns)
        return at < len(self.outages) and self.outages[at] <= moment_ns + within_ns

    def is_online(self, moment_ns: int) -> bool:
        at = bisect_right(self.online, moment_ns, key=lambda span: span[0])
        return at > 0 and self.online[at - 1][1] > moment_ns


def shared(robots: Sequence[Presence]) -> list[list[bool]]:
    """Whether at least half of the robots online, and two, had an outage then; for each outage of each robot."""
    return [[_is_shared(moment, one, robots) for moment in one.outages] for one in robots]


def _is_shared(moment_ns: int, one: Presence, robots: Sequence[Presence]) -> bool:
    online = having = 0
    for other in robots:
        within_ns = max(_WITHIN_NS, one.interval_ns, other.interval_ns)
        has_one = other.has_one_near(moment_ns, within_ns)
        having += has_one
        online += has_one or other.is_online(moment_ns)
    return having >= max(_LEAST, online / 2)
