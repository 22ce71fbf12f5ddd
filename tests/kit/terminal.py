"""A program in a terminal of its own, and a person who types when it asks."""

from __future__ import annotations

import os
import pty
import select
import time
from collections.abc import Sequence
from contextlib import suppress


class Terminal:
    """``shown`` is all that it has shown."""

    def __init__(self, command: Sequence[str]) -> None:
        self.shown, self._answered = "", 0
        self.pid, self._terminal = pty.fork()
        if self.pid == 0:
            os.execvp(command[0], [*command])

    def shows(self, prompt: str, timeout_s: float = 60.0) -> None:
        """Wait until it asks so."""
        self._read_to(prompt, time.monotonic() + timeout_s)

    def answers(self, prompt: str, text: str) -> None:
        """Type a line once it asks so."""
        self.shows(prompt)
        self._answered = len(self.shown)
        os.write(self._terminal, f"{text}\n".encode())

    def ends(self, timeout_s: float = 60.0) -> int:
        """Wait for its end; its exit code."""
        self._read_to(None, time.monotonic() + timeout_s)
        os.close(self._terminal)
        _, status = os.waitpid(self.pid, 0)
        return os.waitstatus_to_exitcode(status)

    def _read_to(self, text: str | None, end: float) -> None:
        while text is None or text not in self.shown[self._answered :]:
            assert time.monotonic() < end, self.shown
            if select.select([self._terminal], [], [], 0.1)[0]:
                part = b""
                with suppress(OSError):  # Linux: the program has ended
                    part = os.read(self._terminal, 4096)
                if not part:
                    break
                self.shown += part.decode(errors="replace")
