"""A terminal that reports each key at once, and notices its own end. Linux and macOS only."""

import os
import select
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from types import FrameType
from typing import Any

from pebble.config.visible import shown
from pebble.extensions.operator.client.terminal.key_decoder import END, KeyDecoder
from pebble.extensions.operator.notices import PrintingThread
from pebble.extensions.operator.signals import handled_by

_READ = 4096
_SHOW_PERIOD_S = 0.1
_HIDE_CURSOR, _SHOW_CURSOR, _ERASE_REST = "\x1b[?25l", "\x1b[?25h", "\x1b[K"


class Terminal:
    """Keys from standard input, and a status line below the shell's lines; see :func:`opened`.

    Another thread prints, as a terminal may stand still.
    """

    def __init__(self) -> None:
        import termios

        self.ended = ""  # why it is over: a signal, Ctrl-D, or a terminal that is gone
        self._termios, self._fd = termios, sys.stdin.fileno()
        self._before: list[Any] = termios.tcgetattr(self._fd)
        self._decoder = KeyDecoder()
        self._line, self._shown_at = "", float("-inf")
        self._waits = False  # the status line, to be printed
        self._printing = PrintingThread()

    def start(self, text: str) -> None:
        """Print ``text``; turn off echo and line input.

        Ctrl-C stays a signal; Ctrl-Z is a key; Ctrl-S has no effect.
        """
        import tty

        tty.setcbreak(self._fd, self._termios.TCSAFLUSH)
        mode = self._termios.tcgetattr(self._fd)
        mode[0] &= ~self._termios.IXON  # of the input flags: Ctrl-S
        mode[6][self._termios.VSUSP] = b"\0"  # of the special characters: Ctrl-Z
        self._termios.tcsetattr(self._fd, self._termios.TCSANOW, mode)
        self._printing.run(partial(_write, text + _HIDE_CURSOR))

    def restore(self) -> None:
        """Restore the terminal; discard unread keys, so that no shell gets them."""
        self._printing.run(partial(_write, "\r\n" + _SHOW_CURSOR))
        with suppress(self._termios.error, OSError):
            self._termios.tcflush(self._fd, self._termios.TCIFLUSH)
            # Not with TCSAFLUSH: that waits for the thread that prints.
            self._termios.tcsetattr(self._fd, self._termios.TCSANOW, self._before)

    def close(self) -> None:
        """Wait until all is printed."""
        self._printing.close()

    def keys(self, seconds: float) -> list[str]:
        """Wait up to ``seconds`` for keys."""
        data, is_gone, due = b"", False, self._decoder.due
        wait_s = seconds if due is None else min(seconds, due - time.monotonic())
        try:
            readable, _, _ = select.select([self._fd], [], [], max(0.0, wait_s))
            if readable and not self.ended:
                data = os.read(self._fd, _READ)
                is_gone = not data
        except OSError:  # EIO: its other end was closed, or this process is in the background for good
            is_gone = True
        if is_gone:
            self.ended = self.ended or "the terminal is gone"
        keys = self._decoder.feed(data, time.monotonic())
        if END in keys:
            self.ended = END
        return keys

    def show(self, status: Callable[[], str], *, at_once: bool) -> None:
        """Show the status if it has changed, a few times a second unless ``at_once``."""
        now = time.monotonic()
        if at_once or now - self._shown_at >= _SHOW_PERIOD_S:
            self._shown_at = now
            if (line := shown(status())) != self._line:
                self._line = line
                if not self._waits:
                    self._waits = True
                    self._printing.run(self._print_line)

    def on_signal(self, number: int, _frame: FrameType | None) -> None:
        """Note a signal that ends the terminal session."""
        self.ended = self.ended or signal.Signals(number).name

    def _print_line(self) -> None:
        self._waits = False  # before the line is read: a newer one is printed after it
        _write(f"\r{self._line[: max(10, shutil.get_terminal_size().columns) - 1]}{_ERASE_REST}")


def _write(text: str) -> None:
    with suppress(OSError):
        os.write(sys.stdout.fileno(), text.encode(errors="replace"))


def has_terminal() -> bool:
    """True if keys can be read: not in a pipe, and not on Windows."""
    try:
        import termios  # noqa: F401
    except ImportError:
        return False
    return sys.stdin.isatty() and sys.stdout.isatty()


@contextmanager
def opened(text: str) -> Iterator[Terminal]:
    """Print ``text``, and yield this process's terminal; restore it at the end, before all is printed."""
    terminal = Terminal()
    try:
        with handled_by(terminal.on_signal, signal.SIGQUIT):
            try:
                terminal.start(text)
                yield terminal
            finally:
                terminal.restore()
    finally:
        terminal.close()  # a signal ends this wait
