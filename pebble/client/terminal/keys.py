"""A terminal that passes on each key at once, and notices when it is lost. Linux and macOS only."""

import os
import select
import shutil
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any, TextIO

from pebble.errors import PebbleError
from pebble.runtime.signals import handled_by

_READ = 4096
_HIDE_CURSOR, _SHOW_CURSOR, _ERASE_REST = b"\x1b[?25l", b"\x1b[?25h", b"\x1b[K"


class Terminal:
    """Standard input as keys, and one status line below the shell's lines; see :func:`opened`.

    ``ended`` says why it is over: a signal, or a terminal that is gone. ``suspended`` is set by Ctrl-Z.
    """

    def __init__(self, keys: TextIO) -> None:
        import termios

        self.ended = ""
        self.suspended = self._continued = False
        self._termios = termios
        self._fd = keys.fileno()
        self._before: list[Any] = termios.tcgetattr(self._fd)
        self._out = _output()
        self._wakeup, self._waker = os.pipe()
        os.set_blocking(self._wakeup, False)
        os.set_blocking(self._waker, False)

    def start(self) -> None:
        """Turn off echo and lines; Ctrl-C and Ctrl-Z stay signals, and Ctrl-S holds nothing back."""
        import tty

        tty.setcbreak(self._fd, self._termios.TCSAFLUSH)
        mode = self._termios.tcgetattr(self._fd)
        mode[0] &= ~self._termios.IXON
        self._termios.tcsetattr(self._fd, self._termios.TCSANOW, mode)
        self._write(_HIDE_CURSOR)

    def restore(self) -> None:
        """Restores the terminal; keys that were not read are forgotten, so that no shell gets them."""
        self._write(b"\r\n" + _SHOW_CURSOR)
        with suppress(self._termios.error, OSError):
            self._termios.tcsetattr(self._fd, self._termios.TCSAFLUSH, self._before)

    def close(self) -> None:
        for descriptor in (self._out, self._wakeup, self._waker):
            os.close(descriptor)

    def read(self, timeout: float) -> bytes:
        """What was typed; waits up to ``timeout`` seconds for something, or for a signal."""
        if self._continued:  # a shell may have changed the mode of the terminal meanwhile
            self._continued = False
            self.start()
        try:
            ready = select.select([self._fd, self._wakeup], [], [], max(0.0, timeout))[0]
            if self._wakeup in ready:
                with suppress(BlockingIOError):
                    os.read(self._wakeup, _READ)
            if self._fd not in ready or self.ended or self.suspended:
                return b""
            data = os.read(self._fd, _READ)
        except OSError:  # EIO: its other end was closed, or this process is in the background for good
            data = b""
        if not data:
            self.ended = self.ended or "the terminal is gone"
        return data

    def show(self, line: str) -> None:
        """Replace the status line; a terminal that is busy misses it."""
        width = max(10, shutil.get_terminal_size().columns)
        self._write(b"\r" + line[: width - 1].encode(errors="replace") + _ERASE_REST)

    def stand_still(self) -> None:
        """Suspend this process as Ctrl-Z usually does; returns when it goes on. Main thread only."""
        self.restore()
        signal.signal(signal.SIGTSTP, signal.SIG_DFL)
        signal.pthread_kill(threading.get_ident(), signal.SIGTSTP)  # to this thread: it acts before the next line
        signal.signal(signal.SIGTSTP, self._on_signal)
        self.suspended, self._continued = False, True

    @contextmanager
    def signals(self) -> Iterator[None]:
        """Note signals, and wake :meth:`read` up."""
        with handled_by(self._on_signal, signal.SIGQUIT, signal.SIGTSTP, signal.SIGCONT):
            waker = signal.set_wakeup_fd(self._waker, warn_on_full_buffer=False)
            try:
                yield
            finally:
                signal.set_wakeup_fd(waker)

    def _on_signal(self, number: int, _frame: FrameType | None) -> None:
        if number == signal.SIGTSTP:
            self.suspended = True
        elif number == signal.SIGCONT:
            self._continued = True
        else:
            self.ended = self.ended or signal.Signals(number).name

    def _write(self, data: bytes) -> None:
        with suppress(OSError):
            os.write(self._out, data)


def _output() -> int:
    """A descriptor of the terminal that alone does not block: a shell shares standard output."""
    try:
        return os.open("/dev/tty", os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError:  # this process has no controlling terminal
        return os.dup(sys.stdout.fileno())


def check_terminal() -> None:
    """Raise PebbleError if this process has no terminal that :func:`opened` can use."""
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise PebbleError(
            "driving by keys needs a terminal; a program publishes with `pebble topic pub drive-values`, or is a script"
        )
    try:
        import termios  # noqa: F401
    except ImportError:
        raise PebbleError("driving by keys needs a terminal of Linux or macOS: use `pebble web` here") from None


@contextmanager
def opened() -> Iterator[Terminal]:
    """The terminal of this process, restored at the end."""
    terminal = Terminal(sys.stdin)
    try:
        with terminal.signals():
            terminal.start()
            try:
                yield terminal
            finally:
                terminal.restore()
    finally:
        terminal.close()
