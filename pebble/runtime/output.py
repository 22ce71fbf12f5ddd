"""The output of commands, as wide as the terminal or not folded in a pipe; and that of robots, which never waits."""

from __future__ import annotations

import os
import select
import sys
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from rich.console import Console

_UNFOLDED = 10_000  # columns
_PIECE = 128  # bytes for which a terminal has room if it has any: it has 256 then
_PIPE_PIECE = getattr(select, "PIPE_BUF", 512)  # bytes that a pipe takes as a whole, if it has room; none on Windows
_LONGEST = 16_384  # bytes of a line, or of a traceback's lines


def console() -> Console:
    """Return a console for tables. In a pipe, lines are neither folded nor cut, unless COLUMNS sets a width."""
    from rich.console import Console

    is_wide = not sys.stdout.isatty() and "COLUMNS" not in os.environ
    return Console(highlight=False, width=_UNFOLDED if is_wide else None)


def discard_output(stream: TextIO) -> None:
    """Discard further output to ``stream``: its reader has ended, or a disk is full."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def has_room(descriptor: int, within_ms: float = 0.0) -> bool:
    """True if a short line can be written without a wait; always on Windows, which cannot tell."""
    if not hasattr(select, "poll"):
        return True
    poll = select.poll()
    poll.register(descriptor, select.POLLOUT)
    return bool(poll.poll(within_ms))


class NonBlockingWriter:
    """A writer of lines that drops them if the descriptor has no room: a stopped terminal must not stop a robot.

    ``patience_s``: so long it waits for a reader, once until that reads again.
    """

    def __init__(self, descriptor: int, patience_s: float = 0.0) -> None:
        self._descriptor, self._patience_ms = descriptor, 1000 * patience_s
        self._piece = _PIECE if os.isatty(descriptor) else _PIPE_PIECE
        self._stalls = False
        self.dropped = 0

    def write(self, line: str) -> None:
        data = line.encode(errors="replace")[: _LONGEST - 1] + b"\n"
        try:
            while data and has_room(self._descriptor, 0 if self._stalls else self._patience_ms):
                self._stalls = False
                data = data[os.write(self._descriptor, data[: self._piece]) :]
        except OSError:  # the reader has gone
            pass
        if data:
            self._stalls = True
            self.dropped += 1
