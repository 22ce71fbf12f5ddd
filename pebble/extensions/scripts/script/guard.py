"""The end of a script by a signal, even if its main thread sleeps, is busy, or is blocked in C code."""

import os
import select
import signal
import threading
import time
from collections.abc import Callable

END_S = 2.0  # for main to return after a signal; the wheels have stopped by then
_PAUSE_S = 0.02
_NUMBERS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


class Guard:
    """A thread that calls ``end(number)`` when a signal arrives, and ends the process 2 s later.

    The kernel's handler only writes a byte into a pipe, and the thread waits for nothing else: a handler in Python
    would run on the main thread, perhaps much later, or while that holds a lock. Code that holds Python's global lock
    for long delays this, too; then the motor owner's deadline stops the wheels, and the kernel ends the process.
    """

    def __init__(self, end: Callable[[int], None]) -> None:
        """Guard the main thread. Call this there."""
        self._end = end
        self._reader, self._writer = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        signal.set_wakeup_fd(self._writer, warn_on_full_buffer=False)
        for number in _NUMBERS:
            if signal.getsignal(number) is not signal.SIG_IGN:  # a shell ignores it for what runs in the background
                signal.signal(number, _let_guard_run)  # without a handler the signal would end the process at once
        os.register_at_fork(after_in_child=self._release)
        threading.Thread(target=self._run, name="pebble-end", daemon=True).start()

    def _run(self) -> None:
        number = self._next(None)
        signal.setitimer(signal.ITIMER_REAL, END_S + 0.5)
        self._end(number)
        self._next(END_S)
        os._exit(128 + number)

    def _next(self, timeout: float | None) -> int:
        """Return the next signal that ends the script.

        ``timeout``: how long to wait for Ctrl-C alone, after another signal; 0 if it does not come.
        """
        wanted = _NUMBERS if timeout is None else (signal.SIGINT,)
        while True:
            readable, _, _ = select.select([self._reader], [], [], timeout)
            if not readable:
                return 0
            for number in os.read(self._reader, 512):  # one byte for each signal
                if number in wanted:
                    return number

    def _release(self) -> None:
        """Let a forked child end as any program does: a signal to it is not one to the script."""
        signal.set_wakeup_fd(-1)
        for number in _NUMBERS:
            signal.signal(number, signal.SIG_DFL)


def _let_guard_run(*_: object) -> None:
    """Pause the main thread if it runs Python: otherwise each step of the guard waits 5 ms for the global lock."""
    time.sleep(_PAUSE_S)
