"""Measures the time to wake up a waiting process on this machine, which every message needs several times."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from pebble.bench.results import percentile
from pebble.errors import PebbleError

_PINGS = 60
_PERIOD_S = 0.005  # as messages at 200 Hz: cores go idle in between


def wake_up_us() -> tuple[float, float]:
    """The time of a wake-up on the same core and on another one, us; equal if there is only one core.

    It is half of the median round trip of a byte through a socket to ``cat``: a round trip is two wake-ups and little
    else. Raises PebbleError without ``cat``.
    """
    cores = sorted(os.sched_getaffinity(0)) if sys.platform == "linux" else [0]
    with _on(cores[0]):
        return _wake_up_us(cores[0]), _wake_up_us(cores[-1])


def _wake_up_us(core: int) -> float:
    near, far = socket.socketpair()
    with near, far:
        try:
            cat = subprocess.Popen(["cat"], stdin=far.fileno(), stdout=far.fileno())
        except OSError as error:
            raise PebbleError(f"cat: {error.strerror}") from None
        with cat:
            if sys.platform == "linux":
                os.sched_setaffinity(cat.pid, {core})
            ways = [_there_and_back_ns(near) for _ in range(_PINGS)]
            near.shutdown(socket.SHUT_WR)  # it ends when its input closes
    return percentile(ways, 50) / 2000


def _there_and_back_ns(near: socket.socket) -> int:
    time.sleep(_PERIOD_S)
    sent = time.monotonic_ns()
    near.send(b".")
    near.recv(1)
    return time.monotonic_ns() - sent


@contextmanager
def _on(core: int) -> Iterator[None]:
    """Pins this thread to a core; processes started later are not affected."""
    if sys.platform != "linux":
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)
