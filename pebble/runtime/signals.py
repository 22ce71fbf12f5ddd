"""The signals that end a program: waited for, handled in a ``with`` block, or turned into KeyboardInterrupt."""

import select
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from pebble.transports.wakeup import WakeupPipe

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")  # the last one is unknown to Windows


class EndSignal:
    """It is set by SIGTERM and SIGINT, or by :meth:`set`, and stays so.

    A handler must not set an event: it may have interrupted the wait for it, which holds its lock, and waits for ever.
    """

    def __init__(self) -> None:
        self._wakeup = WakeupPipe()
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: self.set())

    def set(self) -> None:
        self._wakeup.set()

    def wait(self, timeout: float | None = None) -> bool:
        """Whether it is set within ``timeout`` seconds."""
        return bool(select.select([self._wakeup], [], [], timeout)[0])


@contextmanager
def handled_by(handler: Callable[[int, FrameType | None], Any], *more: int) -> Iterator[None]:
    """Call ``handler`` for what ends a program, and for ``more``, inside the block. Main thread only."""
    numbers = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]
    before = {number: signal.signal(number, handler) for number in (*numbers, *more)}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


@contextmanager
def interrupted_by_signals() -> Iterator[None]:
    """SIGTERM and a closed terminal raise KeyboardInterrupt in the main thread, as Ctrl-C does; a command cleans up."""

    def interrupt(_signal: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    with handled_by(interrupt):
        yield
