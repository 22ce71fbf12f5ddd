"""Resource usage of processes and the clocks of this machine, read from the kernel."""

from __future__ import annotations

import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

_AT_ONCE_NS = 20_000


def cpu_s(pids: Iterable[int]) -> float:
    """CPU seconds of these processes so far, all threads, user and system; 0 for processes that have ended.

    In nanoseconds: /proc counts in ticks of 10 ms, too coarse for slices of less than a second.
    """
    seconds = 0.0
    for pid in pids:
        with suppress(OSError):
            seconds += time.clock_gettime(~pid << 3 | 2)  # the number that clock_getcpuclockid(3) makes of a pid
    return seconds


def wake_ups(pids: Iterable[int]) -> int:
    """How often threads of these processes have been woken up so far; 0 for processes that have ended."""
    threads = (found for pid in pids for found in Path("/proc").glob(f"{pid}/task/*/status"))
    return _sum(threads, "voluntary_ctxt_switches:")


def pss_mb(pid: int) -> float:
    """Proportional set size: shared pages are divided among their users; 0 for a process that has ended."""
    return _sum([Path(f"/proc/{pid}/smaps_rollup")], "Pss:") / 1024


def _sum(files: Iterable[Path], *fields: str) -> int:
    total = 0
    for file in files:
        with suppress(FileNotFoundError, ProcessLookupError):  # the process has ended
            total += sum(int(line.split()[1]) for line in file.read_text().splitlines() if line.startswith(fields))
    return total


def wall_clock_ahead_ns() -> int:
    """Ahead of CLOCK_MONOTONIC: a stamp of the wall clock minus this is one of that."""
    while True:
        before, wall, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        if after - before < _AT_ONCE_NS:  # else this thread stood still in between
            return wall - (before + after) // 2
