"""Resource usage of running and ended processes, from the kernel."""

import os
import time

from pebble.extensions.lab.bench.usage import cpu_s, pss_mb

GONE = 1 << 22  # above the largest pid


def test_cpu_time_is_finer_than_ticks() -> None:
    before, end = cpu_s([os.getpid()]), time.process_time() + 0.003
    while time.process_time() < end:
        pass
    assert 0.003 <= cpu_s([os.getpid(), GONE]) - before < 5


def test_memory_of_an_ended_process_is_zero() -> None:
    assert pss_mb(os.getpid()) > 1
    assert pss_mb(GONE) == 0
