"""The resource usage of processes, and this machine's clocks, read from the kernel."""

from __future__ import annotations

import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

_AT_ONCE_NS = 20_000


def cpu_s(pids: Iterable[int]) -> float:
    """Return the CPU seconds of these processes so far, all threads, user and system; 0 for ended processes.

    The resolution is a nanosecond: /proc counts in ticks of 10 ms, too coarse for slices of less than a second.
    """
    seconds = 0.0
    for pid in pids:
        with suppress(OSError):
            seconds += time.clock_gettime(~pid << 3 | 2)  # the number that clock_getcpuclockid(3) makes of a pid
    return seconds


def pss_mb(pid: int) -> float:
    """Return the proportional set size, in which shared pages are divided among their users; 0 if it has ended."""
    with suppress(FileNotFoundError, ProcessLookupError):
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
        return sum(int(line.split()[1]) for line in lines if line.startswith("Pss:")) / 1024
    return 0.0


def threads(pid: int) -> int:
    """Return the number of a process's threads; 0 if it has ended."""
    with suppress(OSError):
        return len(list(Path(f"/proc/{pid}/task").iterdir()))
    return 0


def wall_clock_ahead_ns() -> int:
    """Return how far the wall clock is ahead of CLOCK_MONOTONIC, to convert its time stamps."""
    while True:
        before, wall, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        if after - before < _AT_ONCE_NS:  # else this thread stood still in between
            return wall - (before + after) // 2
