"""Resource usage of running and ended processes, from the kernel."""

import os
import sys
import time
from pathlib import Path

import pytest

from pebble.errors import PebbleError
from pebble.extensions.lab.bench.usage import cpu_s, pss_mb, wall_clock_ahead_ns
from pebble.extensions.lab.rig.processes import Worker, children
from tests.support import Child

GONE = 1 << 22  # above the largest pid


def test_cpu_time_is_finer_than_ticks() -> None:
    before, end = cpu_s([os.getpid()]), time.process_time() + 0.003
    while time.process_time() < end:
        pass
    assert 0.003 <= cpu_s([os.getpid(), GONE]) - before < 5


def test_how_far_the_wall_clock_is_ahead() -> None:
    assert abs(time.time_ns() - wall_clock_ahead_ns() - time.monotonic_ns()) < 500_000_000


def test_a_child_is_found_by_its_parent() -> None:
    child = Child([sys.executable, "-c", "input()"], stdin=-1)
    assert child.pid in children(os.getpid())
    assert children(child.pid) == []
    child.communicate()
    assert child.pid not in children(os.getpid())


def test_memory_of_an_ended_process_is_zero() -> None:
    assert pss_mb(os.getpid()) > 1
    assert pss_mb(GONE) == 0


def test_a_worker_that_has_ended_is_reported_when_asked(tmp_path: Path) -> None:
    worker = Worker("sender", [sys.executable, "-c", "exit('no broker')"], tmp_path / "log")
    with pytest.raises(PebbleError, match="no broker"):
        worker.answer(20)
    worker.send("1")
    worker.ask_to_end()
