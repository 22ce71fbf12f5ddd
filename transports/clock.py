"""The clock by which messages age: it goes on while the machine is suspended, and cannot be set."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable

_NAMES = ("CLOCK_BOOTTIME", "CLOCK_MONOTONIC")  # of Linux; of macOS, whose time.monotonic() stands still
_CLOCK: int | None = next((getattr(time, name) for name in _NAMES if hasattr(time, name)), None)


#: Seconds on a clock that all processes of a machine share, where the system has one; else ``time.monotonic()``.
#: No function of Python: it is called some ten times for each message.
since_boot: Callable[[], float] = time.monotonic if _CLOCK is None else functools.partial(time.clock_gettime, _CLOCK)
