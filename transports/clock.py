"""The clock by which messages age. It also counts while the machine is suspended, and nobody can set it."""

import time
from collections.abc import Callable
from functools import partial
from typing import Final

_NAMES = ("CLOCK_BOOTTIME", "CLOCK_MONOTONIC")  # of Linux; of macOS, whose time.monotonic() stands still
_CLOCK: Final[int | None] = next((getattr(time, name) for name in _NAMES if hasattr(time, name)), None)

#: Seconds on a clock that all processes of a machine share, where the system has one; else ``time.monotonic()``.
since_boot: Callable[[], float] = time.monotonic if _CLOCK is None else partial(time.clock_gettime, _CLOCK)
