"""SIGTERM, SIGINT and SIGHUP as something an event loop can wait for."""

from __future__ import annotations

import signal
import socket
from collections.abc import Callable
from types import FrameType
from typing import Any, Self

_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


class StopSignals:
    """From ``with`` on, counts stop signals instead of dying from them; ``wake`` is readable after each one.

    ``at_once`` is called in the signal handler from the second one on: somebody does not want to wait any longer.
    Main thread only. A signal that was ignored before (nohup) stays ignored.
    """

    def __init__(self, at_once: Callable[[], None]) -> None:
        self.received = 0
        self._at_once = at_once
        self._before: dict[signal.Signals, Any] = {}

    @property
    def wake(self) -> int:
        return self._wakes.fileno()

    def drain(self) -> None:
        """Read what :attr:`wake` announced."""
        self._wakes.recv(64)

    def __enter__(self) -> Self:
        self._waker, self._wakes = socket.socketpair()
        self._waker.setblocking(False)
        self._wakes.setblocking(False)
        self._wakeup_before = signal.set_wakeup_fd(self._waker.fileno(), warn_on_full_buffer=False)
        for number in _SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:
                self._before[number] = signal.signal(number, self._receive)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._wakeup_before)
        self._waker.close()
        self._wakes.close()

    def _receive(self, _number: int, _frame: FrameType | None) -> None:
        self.received += 1
        if self.received > 1:
            self._at_once()
