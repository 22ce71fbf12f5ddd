"""What a child process writes, as lines with levels. Pure."""

from __future__ import annotations

import re

LINE_LIMIT = 16_384  # bytes; the rest of a longer line is dropped
LEVELS = ("DEBUG", "INFO", "WARNING", "ERROR", "CRITICAL")

_FORM = re.compile(r"\d\d:\d\d:\d\d(?:[.,]\d+)? \[([A-Z]+)\] (.*)", re.DOTALL).fullmatch
_TRACEBACK = re.compile(r"[\s|+]*(Exception Group )?Traceback \(most recent call last\):").match


class LineSplitter:
    """Bytes in any pieces to lines of text; never holds more than LINE_LIMIT bytes, whatever it is fed."""

    def __init__(self) -> None:
        self._pending = b""
        self._skipping = False  # inside the rest of a line that was too long

    def feed(self, data: bytes) -> list[str]:
        *ended, self._pending = (self._pending + data).split(b"\n")
        if self._skipping and ended:
            del ended[0]
            self._skipping = False
        if self._skipping:
            self._pending = b""
        elif len(self._pending) > LINE_LIMIT:
            ended.append(self._pending)
            self._pending, self._skipping = b"", True
        return [text for line in ended if (text := _text(line))]

    def rest(self) -> list[str]:
        """What is left when the writer has gone without a final newline."""
        left, self._pending = self._pending, b""
        return [text] if (text := _text(left)) else []


def _text(line: bytes) -> str:
    return line[:LINE_LIMIT].decode(errors="replace").rstrip()


class LevelReader:
    """The level of each line of one process: ``HH:MM:SS [LEVEL] text`` says it, other lines are INFO (paper A.8.7).

    A traceback, up to the next line that says its level, has that of the line it belongs to; ERROR without one.
    Indented lines continue what came before them.
    """

    def __init__(self) -> None:
        self._said: str | None = None
        self._in_traceback = False

    def read(self, line: str) -> tuple[str, str]:
        """The level and the text of ``line``."""
        form = _FORM(line)
        level = _known(form[1]) if form else None
        if form and level:
            self._said, self._in_traceback = level, False
            return level, form[2]
        if _TRACEBACK(line):
            self._in_traceback = True
            self._said = self._said or "ERROR"
        if self._said and (self._in_traceback or line[0].isspace()):
            return self._said, line
        self._said = None
        return "INFO", line


def _known(level: str) -> str | None:
    level = {"WARN": "WARNING", "FATAL": "CRITICAL"}.get(level, level)
    return level if level in LEVELS else None


def cut(text: str, limit: int) -> str:
    """At most ``limit`` characters; what was longer ends in three dots."""
    return text if len(text) <= limit else text[: limit - 3] + "..."
