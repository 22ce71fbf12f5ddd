"""The signals that end a program: an event, a handler in a ``with`` block, or KeyboardInterrupt."""

import select
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from pebble.transports.wakeup import WakeupPipe

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")  # the last one is unknown to Windows


def _numbers() -> list[signal.Signals]:
    return [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]


class EndSignal:
    """An event that signals, or :meth:`set`, set for good. Make it on the main thread.

    This is no threading.Event: a handler may have interrupted a wait for it, which holds its lock, and would wait for
    ever. And a signal on a thread of a library interrupts no wait of this one: the pipe ends it.
    """

    def __init__(self) -> None:
        self._wakeup = WakeupPipe()
        signal.set_wakeup_fd(self._wakeup.set_fileno, warn_on_full_buffer=False)
        for number in _numbers():
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, lambda *_: self.set())

    def set(self) -> None:
        self._wakeup.set()

    def wait(self, timeout: float | None = None) -> bool:
        """True if it is set within ``timeout`` seconds."""
        return bool(select.select([self._wakeup], [], [], timeout)[0])


@contextmanager
def handled_by(handler: Callable[[int, FrameType | None], Any], *more: int) -> Iterator[None]:
    """Call ``handler`` for signals that end a program, and for ``more``, inside the block. Main thread only."""
    before = {number: signal.signal(number, handler) for number in (*_numbers(), *more)}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


@contextmanager
def interrupted_by_signals() -> Iterator[None]:
    """Raise KeyboardInterrupt in the main thread also on SIGTERM and SIGHUP: a command cleans up as after Ctrl-C."""

    def interrupt(_signal: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    with handled_by(interrupt):
        yield
