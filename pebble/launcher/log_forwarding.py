"""Forwards the log lines of all processes to the launcher's stderr and to the robot's log topic (paper A.8.7)."""

import logging
import os
import re
import sys
import time
from collections.abc import Callable
from typing import Self

from pebble.config.secret_text import without_secrets
from pebble.config.visible import shown
from pebble.contract.payloads import LogRecord
from pebble.runtime.output import NonBlockingWriter
from pebble.runtime.parent import TAG

LINE_LIMIT = 16_384  # bytes of a child's line; the rest of a longer line is dropped
LEVELS = ("DEBUG", "INFO", "WARNING", "ERROR", "CRITICAL")

_OWN_NAME = "launcher"
_LEAST = LEVELS.index("INFO")  # of the levels that are published
_LONGEST = 2048  # characters; longer lines are cut and end in three dots
_FORM = re.compile(r"\d\d:\d\d:\d\d(?:[.,]\d+)? \[([A-Z]+)\] (.*)", re.DOTALL).fullmatch
_TRACEBACK = re.compile(r"[\s|+]*(Exception Group )?Traceback \(most recent call last\):").match


class LogForwarder:
    """A writer of every line to stderr. Lines of INFO and above also go to ``publish``, as records."""

    def __init__(self, publish: Callable[[LogRecord], None], *, stderr: int | None = None) -> None:
        self._publish = publish
        self._stderr = NonBlockingWriter(sys.stderr.fileno() if stderr is None else stderr)
        self._readers: dict[str, tuple[int, LevelReader]] = {}  # with the process id, by service

    def child_line(self, service: str, pid: int, line: str, *, published: bool = True) -> None:
        """Forward a child's line. Lines of .announcer, which publishes, are not published: each could cause another."""
        last_pid, reader = self._readers.get(service, (pid, None))
        if reader is None or last_pid != pid:  # the level of the last line belongs to the previous process
            reader = LevelReader()
            self._readers[service] = (pid, reader)
        level, text = reader.read(line)
        self._forward(level, service, pid, text, logger="root", published=published)

    def tagged_line(self, service: str, pid: int, line: str) -> None:
        """Forward a line of a child; a tag in the line may name a process of the child as its source."""
        tag = TAG.fullmatch(line)
        if tag is None:
            self.child_line(service, pid, line)
        elif tag[3].strip():
            self.child_line(f"{service}:{tag[1]}", int(tag[2]), tag[3])

    def own_record(self, record: logging.LogRecord, text: str) -> None:
        """Forward a log record of the launcher."""
        place = record.levelno // 10 - 1  # DEBUG is 10, INFO 20; a level between two counts as the lower
        level = LEVELS[min(max(place, 0), len(LEVELS) - 1)]
        self._forward(level, _OWN_NAME, os.getpid(), text, logger=record.name)

    def _forward(self, level: str, service: str, pid: int, text: str, *, logger: str, published: bool = True) -> None:
        clock = time.strftime("%H:%M:%S")
        for line in text.splitlines():
            self._stderr.write(f"{clock} [{level}] [{service}] {line}")
        if published and LEVELS.index(level) >= _LEAST:
            whole = f"[{service}] {text}"
            message = whole if len(whole) <= _LONGEST else whole[: _LONGEST - 3] + "..."
            now_ms = time.time_ns() // 1_000_000
            self._publish(LogRecord(t=now_ms, level=level, service=service, message=message, logger=logger, pid=pid))


class OwnRecords(logging.Handler):
    """A log handler that forwards the launcher's own records inside its ``with`` block."""

    def __init__(self, forwarder: LogForwarder, level: str) -> None:
        super().__init__()
        self._forwarder, self._level = forwarder, level
        self._previous_level = logging.WARNING

    def __enter__(self) -> Self:
        root = logging.getLogger()
        self._previous_level = root.level
        root.addHandler(self)
        root.setLevel(self._level)
        return self

    def __exit__(self, *_: object) -> None:
        root = logging.getLogger()
        root.removeHandler(self)
        root.setLevel(self._previous_level)

    def emit(self, record: logging.LogRecord) -> None:
        self._forwarder.own_record(record, self.format(record))


class LevelReader:
    """A reader of the levels of one process's lines: ``HH:MM:SS [LEVEL] text``; other lines are INFO (paper A.8.7).

    A traceback, up to the next line that names its level, has the level of the line before it; ERROR if that names
    none. Indented lines continue the line before them.
    """

    def __init__(self) -> None:
        self._last_level: str | None = None
        self._in_traceback = False

    def read(self, line: str) -> tuple[str, str]:
        """Return the level and the text of ``line``."""
        form = _FORM(line)
        level = _known(form[1]) if form else None
        if form and level:
            self._last_level, self._in_traceback = level, False
            return level, form[2]
        if _TRACEBACK(line):
            self._in_traceback = True
            self._last_level = self._last_level or "ERROR"
        if self._last_level and (self._in_traceback or line[0].isspace()):
            return self._last_level, line
        self._last_level = None
        return "INFO", line


def text_of(line: bytes) -> str:
    """Return a line of any bytes as text, without the logins that foreign programs may print."""
    return shown(without_secrets(line.decode(errors="replace").rstrip()))


def _known(level: str) -> str | None:
    level = {"WARN": "WARNING", "FATAL": "CRITICAL"}.get(level, level)
    return level if level in LEVELS else None
