"""Resource usage of processes, read from the kernel, and the time in which this machine wakes up a process."""

from __future__ import annotations

import os
import socket
import subprocess
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from statistics import median_low

_PINGS = 60
_PERIOD_S = 0.005  # as messages at 200 Hz: cores go idle in between


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


def wake_up_us() -> tuple[float, float]:
    """The time to wake up a waiting process on the same core and on another one, us: half of a round trip to cat."""
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, cores[:1])  # this thread, and processes that it starts meanwhile
    try:
        return _wake_up_us(cores[0]), _wake_up_us(cores[-1])
    finally:
        os.sched_setaffinity(0, cores)


def _wake_up_us(core: int) -> float:
    near, far = socket.socketpair()
    with near, far, subprocess.Popen(["cat"], stdin=far.fileno(), stdout=far.fileno()) as cat:
        os.sched_setaffinity(cat.pid, {core})
        ways = []
        for _ in range(_PINGS):
            time.sleep(_PERIOD_S)
            sent = time.monotonic_ns()
            near.send(b".")
            near.recv(1)
            ways.append(time.monotonic_ns() - sent)
        near.shutdown(socket.SHUT_WR)  # it ends when its input closes
    return median_low(ways) / 2000
