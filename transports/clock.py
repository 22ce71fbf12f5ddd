"""The clock by which messages age: it goes on while the machine is suspended, and cannot be set."""

from __future__ import annotations

import time


def since_boot() -> float:
    """Seconds on a clock that all processes of a machine share, where the system has one; else ``time.monotonic()``."""
    for name in ("CLOCK_BOOTTIME", "CLOCK_MONOTONIC"):  # of Linux; of macOS, whose time.monotonic() stands still
        if hasattr(time, name):
            return time.clock_gettime(getattr(time, name))
    return time.monotonic()
