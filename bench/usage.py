"""Resource usage of processes, read from the kernel."""

from __future__ import annotations

import time
from collections.abc import Iterable
from pathlib import Path

from pebble.errors import PebbleError

_PROC = Path("/proc")


def cpu_s(pids: Iterable[int]) -> float:
    """CPU seconds of these processes so far, all threads, user and system; 0 for processes that have ended.

    In nanoseconds: /proc counts in ticks of 10 ms, too coarse for slices of less than a second.
    """
    return sum(map(_cpu_s, pids))


def _cpu_s(pid: int) -> float:
    try:
        return time.clock_gettime(~pid << 3 | 2)  # the number that clock_getcpuclockid(3) makes of a pid
    except OSError:
        return 0.0


def wake_ups(pids: Iterable[int]) -> int:
    """How often threads of these processes have been woken up so far; 0 for processes that have ended."""
    return sum(_switches(task) for pid in pids for task in _PROC.glob(f"{pid}/task/*"))


def _switches(task: Path) -> int:
    try:
        lines = (task / "status").read_text().splitlines()
    except (FileNotFoundError, ProcessLookupError):  # it has ended meanwhile
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("voluntary_ctxt_switches:")), 0)


def pss_mb(pid: int) -> float:
    """Proportional set size: shared pages are divided among their users. 0 for a process that has ended.

    Raises PebbleError if the kernel does not provide it.
    """
    return _memory_mb(pid, "Pss:")


def own_mb(pid: int) -> float:
    """What a process has allocated, without the pages of programs and libraries: only it can make this grow.

    The proportional set size grows too when another process ends with which pages were shared. Shared memory is divided
    among its users. 0 for a process that has ended. Raises PebbleError if the kernel does not provide it.
    """
    return _memory_mb(pid, "Anonymous:", "Pss_Shmem:")


def _memory_mb(pid: int, *fields: str) -> float:
    try:
        lines = (_PROC / str(pid) / "smaps_rollup").read_text().splitlines()
    except (FileNotFoundError, PermissionError) as error:
        if (_PROC / str(pid)).exists():
            raise PebbleError(f"{error.filename}: {error.strerror}: memory cannot be measured without it") from None
        return 0.0
    except ProcessLookupError:
        return 0.0
    return sum(int(line.split()[1]) for line in lines if line.startswith(fields)) / 1024
