"""The clock by which messages age: it goes on while the machine is suspended, and cannot be set."""

from __future__ import annotations

import time

_NAMES = ("CLOCK_BOOTTIME", "CLOCK_MONOTONIC")  # of Linux; of macOS, whose time.monotonic() stands still
_CLOCK: int | None = next((getattr(time, name) for name in _NAMES if hasattr(time, name)), None)


def since_boot() -> float:
    """Seconds on a clock that all processes of a machine share, where the system has one; else ``time.monotonic()``."""
    return time.monotonic() if _CLOCK is None else time.clock_gettime(_CLOCK)
