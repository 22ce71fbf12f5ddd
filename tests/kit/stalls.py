"""Detects times at which the machine did not run processes that were ready: lateness then proves nothing."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterable
from functools import cache

from tests.support import WAIT_S, Child

_PULSE = """
import os, sys, time
os.sched_setaffinity(0, {int(sys.argv[1])})
last = time.monotonic()
while True:
    time.sleep(0.01)
    now = time.monotonic()
    if now - last > 0.02:
        print(last, now, flush=True)
    last = now
"""

#: From when until when (monotonic).
Stall = tuple[float, float]


def lost_s(stalls: Iterable[Stall], since: float, until: float) -> float:
    """Return the seconds of this time that lie in at least one stall."""
    lost, end = 0.0, since
    for began, ended in sorted(stalls):
        began, ended = max(began, end), min(ended, until)
        if ended > began:
            lost, end = lost + ended - began, ended
    return lost


class Stalls:
    """A watch: a small process per processor wakes every 10 ms, and reports when it was 10 ms late or more."""

    def __init__(self) -> None:
        self._found: list[Stall] = []
        self._processes = [
            Child([sys.executable, "-S", "-c", _PULSE, str(cpu)], stdout=subprocess.PIPE, text=True)
            for cpu in sorted(os.sched_getaffinity(0))
        ]
        for process in self._processes:
            threading.Thread(target=self._read, args=(process,), daemon=True).start()

    def close(self) -> None:
        for process in self._processes:
            process.kill()
            process.wait(WAIT_S)

    @property
    def found(self) -> list[Stall]:
        return list(self._found)

    def _read(self, process: Child) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            began, ended = map(float, line.split())
            self._found.append((began, ended))


@cache
def stalls() -> Stalls:
    """Return the watch of this process, which ends with it."""
    return Stalls()
