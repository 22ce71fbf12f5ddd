"""Resource usage of running and ended processes, from the kernel."""

import mmap
import os
import sys
import time
from pathlib import Path

import pytest

from pebble.bench.usage import cpu_s, pss_mb, wall_clock_ahead_ns
from pebble.errors import PebbleError
from pebble.rig.processes import Worker, children
from tests.own_memory import own_mb
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


def test_a_process_owns_what_it_allocates_but_not_the_files_that_it_reads(tmp_path: Path) -> None:
    size = 32 << 20
    (tmp_path / "program").write_bytes(bytes(size))
    with (tmp_path / "program").open("rb") as file, mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ) as program:
        own, proportional = own_mb(os.getpid()), pss_mb(os.getpid())
        assert not any(program[at] for at in range(0, size, mmap.PAGESIZE))
        assert own_mb(os.getpid()) < own + 16
        assert pss_mb(os.getpid()) > proportional + 16
    allocated = bytearray(os.urandom(size))
    assert own_mb(os.getpid()) > own + 16
    assert len(allocated) == size
    assert own_mb(GONE) == 0


def test_a_worker_that_has_ended_is_reported_when_asked(tmp_path: Path) -> None:
    worker = Worker("sender", [sys.executable, "-c", "exit('no broker')"], tmp_path / "log")
    with pytest.raises(PebbleError, match="no broker"):
        worker.answer(20)
    worker.send("1")
    worker.ask_to_end()
