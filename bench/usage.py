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

from pebble.errors import PebbleError

_PROC = Path("/proc")
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
    count = 0
    for status in (found for pid in pids for found in _PROC.glob(f"{pid}/task/*/status")):
        with suppress(FileNotFoundError, ProcessLookupError):  # it has ended meanwhile
            count += _sum(status, "voluntary_ctxt_switches:")
    return count


def pss_mb(pid: int) -> float:
    """Proportional set size: shared pages are divided among their users; 0 for a process that has ended."""
    return _memory_mb(pid, "Pss:")


def own_mb(pid: int) -> float:
    """What a process has allocated, and its share of shared memory: unlike its PSS, no other process changes it."""
    return _memory_mb(pid, "Anonymous:", "Pss_Shmem:")


def _memory_mb(pid: int, *fields: str) -> float:
    file = _PROC / str(pid) / "smaps_rollup"
    try:
        return _sum(file, *fields) / 1024
    except OSError as error:
        if file.parent.exists() and not isinstance(error, ProcessLookupError):
            raise PebbleError(f"{file}: {error.strerror}: memory cannot be measured without it") from None
        return 0.0


def _sum(file: Path, *fields: str) -> int:
    return sum(int(line.split()[1]) for line in file.read_text().splitlines() if line.startswith(fields))


def wake_up_us() -> tuple[float, float]:
    """The time to wake up a waiting process, us, on the same core and on another one: half of a round trip to ``cat``."""
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
