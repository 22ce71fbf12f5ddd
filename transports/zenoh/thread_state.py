"""Keeps Python's state of a thread of Zenoh's between two callbacks.

Zenoh's threads are Rust's. For each callback Python makes such a thread a state, with memory of its own from the
kernel, and frees it afterwards: an mmap, an munmap and the faults of new pages for each message (Python 3.11), 5 % of
what one costs. A state that was asked for once more than it is given back stays (PyGILState_Ensure of Python's C API),
also when its thread ends: some 17 KB. Zenoh has a few threads for all sessions of a process, and seldom a new one
(forty sessions, one after the other: five); so that no number of them matters, only the first ones keep it.
"""

from __future__ import annotations

import ctypes
import itertools
import threading
from collections.abc import Callable
from typing import Any

import zenoh

MOST = 32  # threads of a process that keep their state

_ensure = ctypes.pythonapi.PyGILState_Ensure
_remembered = threading.local()  # part of the state: empty in a new one
_numbers = itertools.count()


def keep_thread_state() -> None:
    """Let the calling thread keep its state until it ends; to be called at the beginning of each callback."""
    if not hasattr(_remembered, "it"):
        _remembered.it = True
        if next(_numbers) < MOST:
            _ensure()


def direct(function: Callable[[Any], None]) -> zenoh.handlers.Callback[Any]:
    """Run on Zenoh's receiving thread. Zenoh's default would queue, and then block that thread for all."""

    def run(received: Any) -> None:
        keep_thread_state()
        function(received)

    return zenoh.handlers.Callback(run, indirect=False)
