"""A program in a terminal of its own, and a person who types when it asks, or holds a key."""

from __future__ import annotations

import os
import pty
import select
import subprocess
import termios
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tests.support import ROOT, WAIT_S, until

SHELL = {"PS1": "$ ", "TERM": "xterm", "COLUMNS": "200", "HISTFILE": "/dev/null"}


class Terminal:
    """The terminal. ``shown`` is everything that it has shown, since ``forget`` if that was called."""

    def __init__(self, *command: str, cwd: Path = ROOT) -> None:
        self.master, slave = pty.openpty()
        self.mode = termios.tcgetattr(slave)
        self._slave = slave  # open: so the mode can be read after the process has ended
        self.process = subprocess.Popen(
            ["setsid", "--ctty", *command], cwd=cwd, stdin=slave, stdout=slave, stderr=slave, env=os.environ | SHELL
        )
        self._held = b""
        self._shown = b""
        self._answered = 0  # so much of what is shown is answered
        self._ending = threading.Event()
        self._reading = threading.Lock()
        self._threads = [threading.Thread(target=job, daemon=True) for job in (self._read, self._repeat)]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        self.hang_up()
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait(WAIT_S)

    def hang_up(self) -> None:
        """Close the terminal, as its window does."""
        self._ending.set()
        for thread in self._threads:
            thread.join()
        for descriptor in (self.master, self._slave):
            if descriptor >= 0:
                os.close(descriptor)
        self.master = self._slave = -1

    def ends(self, timeout_s: float = 60.0) -> int:
        """Wait for the end of the process; return its exit code."""
        code = self.process.wait(timeout_s)
        assert until(lambda: not select.select([self.master], [], [], 0)[0]), "what it has shown last is read"
        self.close()
        return code

    # -- what is typed

    def type(self, keys: bytes) -> None:
        os.write(self.master, keys)

    def hold(self, key: bytes) -> None:
        """Repeat a key, as a terminal does after its first delay; b"" releases it."""
        self._held = key

    def answers(self, prompt: str, text: str) -> None:
        """Type ``text`` as a line when the program shows ``prompt``."""
        self.shows(prompt)
        self._answered = len(self._shown)
        self.type(f"{text}\n".encode())

    # -- what is shown

    def sees(self, text: str, timeout: float = WAIT_S) -> bool:
        return until(lambda: text in self.shown, timeout)

    def shows(self, prompt: str, timeout_s: float = 60.0) -> None:
        """Wait until the program shows ``prompt``, after the last answer."""
        assert until(lambda: prompt.encode() in self._shown[self._answered :], timeout_s), self.shown

    @property
    def shown(self) -> str:
        return self._shown.decode(errors="replace")

    def forget(self) -> None:
        self._shown, self._answered = b"", 0

    @contextmanager
    def standing_still(self) -> Iterator[None]:
        """Show nothing, and have no room for anything more to show, as the terminal of a frozen ssh."""
        with self._reading:
            os.set_blocking(self._slave, False)
            with suppress(BlockingIOError):
                while os.write(self._slave, b"x"):
                    pass
            os.set_blocking(self._slave, True)
            yield

    @property
    def restored(self) -> bool:
        """True if the terminal has the mode that it had before the process."""
        return termios.tcgetattr(self._slave) == self.mode

    def _read(self) -> None:
        while not self._ending.is_set():
            if select.select([self.master], [], [], 0.05)[0]:
                try:
                    with self._reading:
                        self._shown += os.read(self.master, 65536)
                except OSError:
                    return

    def _repeat(self) -> None:
        while not self._ending.wait(0.03):
            if self._held:
                os.write(self.master, self._held)
