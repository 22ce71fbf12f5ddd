"""Whether this machine has processor time left: simulated hardware stands still without it.

A real motor MCU has a processor of its own, so what a simulated one does late on an overloaded machine says nothing
about robots.
"""

import time
from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

_STAT = Path("/proc/stat")
_SAMPLES = 750  # five minutes
_SLICE_S = 0.4  # shorter ones say little, at 100 ticks a second
_LEAST_IDLE, _MOST_TAKEN = 0.06, 0.12  # shares of all processors
_IDLE, _IOWAIT, _STEAL, _FIELDS = 3, 4, 7, 8  # of the first line of /proc/stat, man 5 proc_stat


@dataclass(frozen=True, slots=True)
class Sample:
    """Processor time since boot, in ticks."""

    at: float  # monotonic seconds
    idle: int
    taken: int  # by other guests of the same host
    total: int


class Machine:
    """Call ``sample`` several times a second; where the system does not count, the machine is never overloaded."""

    def __init__(self) -> None:
        self._samples: deque[Sample] = deque(maxlen=_SAMPLES)

    def sample(self) -> None:
        now = time.monotonic()
        if self._samples and now - self._samples[-1].at < _SLICE_S:
            return
        try:
            ticks = [int(word) for word in _STAT.read_text(encoding="utf-8").split("\n", 1)[0].split()[1 : _FIELDS + 1]]
            self._samples.append(Sample(now, ticks[_IDLE] + ticks[_IOWAIT], ticks[_STEAL], sum(ticks)))
        except (OSError, ValueError, IndexError):  # another system
            return

    def overloaded(self, began: float, ended: float, *, on_average: bool = False) -> str:
        """Why what was measured between these times (monotonic) may be late, in words; empty: no reason."""
        self.sample()
        return overloaded(list(self._samples), began, ended, on_average=on_average)


def overloaded(samples: list[Sample], began: float, ended: float, *, on_average: bool = False) -> str:
    """The worst slice of that time decides, since a deadline is missed in one; of a rate, the whole time. Pure."""
    slices = [(before, after) for before, after in pairwise(samples) if before.at < ended and after.at > began]
    if on_average and slices:
        slices = [(slices[0][0], slices[-1][1])]
    shares = [
        ((after.taken - before.taken) / total, (after.idle - before.idle) / total)
        for before, after in slices
        if (total := after.total - before.total) > 0
    ]
    worst = max(shares, key=lambda share: share[0] - share[1], default=(0.0, 1.0))
    if worst[0] > _MOST_TAKEN or worst[1] < _LEAST_IDLE:
        return f"{worst[0]:.0%} of the processors were taken by other guests, {worst[1]:.0%} were idle"
    return ""
