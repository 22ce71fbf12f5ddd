"""Where log lines go: the launcher's own stderr, and as records to whoever watches the robot (paper A.8.7)."""

from __future__ import annotations

import logging
import os
import select
import sys
import time
from collections.abc import Callable
from typing import Self

from pebble.config.tree import LogsSection
from pebble.launcher.log_lines import LEVELS, LevelReader, cut
from pebble.payloads import LogRecord

_OWN_NAME = "launcher"


class LogForwarder:
    """Echoes every line, and hands those that are important enough to ``publish`` as records."""

    def __init__(self, publish: Callable[[LogRecord], None], logs: LogsSection, *, echo: int | None = None) -> None:
        self._publish, self._limit = publish, logs.max_message_chars
        self._least = LEVELS.index(logs.min_level)
        self._echo = Echo(sys.stderr.fileno() if echo is None else echo)
        self._readers: dict[str, LevelReader] = {}

    def child_line(self, service: str, pid: int, line: str, *, published: bool = True) -> None:
        """One line that the child ``service`` wrote. Those of whoever publishes them would make new ones for ever."""
        level, text = self._readers.setdefault(service, LevelReader()).read(line)
        self._say(level, service, pid, text, logger="root", published=published)

    def child_started(self, service: str) -> None:
        """What the one before wrote has nothing to do with what comes."""
        self._readers.pop(service, None)

    def own_record(self, record: logging.LogRecord, text: str) -> None:
        level = LEVELS[min(max(record.levelno // 10 - 1, 0), len(LEVELS) - 1)]  # others' levels lie in between
        self._say(level, _OWN_NAME, os.getpid(), text, logger=record.name)

    def _say(self, level: str, service: str, pid: int, text: str, *, logger: str, published: bool = True) -> None:
        clock = time.strftime("%H:%M:%S")
        for line in text.splitlines():
            self._echo.write(f"{clock} [{level}] [{service}] {line}")
        if published and LEVELS.index(level) >= self._least:
            message = cut(f"[{service}] {text}", self._limit)
            now_ms = time.time_ns() // 1_000_000
            self._publish(LogRecord(t=now_ms, level=level, service=service, message=message, logger=logger, pid=pid))


class OwnRecords(logging.Handler):
    """The launcher's own log, the same two ways, from ``with`` on."""

    def __init__(self, forwarder: LogForwarder, level: str) -> None:
        super().__init__()
        self._forwarder, self._level = forwarder, level

    def __enter__(self) -> Self:
        root = logging.getLogger()
        self._level_before = root.level
        root.addHandler(self)
        root.setLevel(self._level)
        return self

    def __exit__(self, *_: object) -> None:
        root = logging.getLogger()
        root.removeHandler(self)
        root.setLevel(self._level_before)

    def emit(self, record: logging.LogRecord) -> None:
        self._forwarder.own_record(record, self.format(record))


class Echo:
    """Writes lines to a descriptor, but never waits for whoever reads there: a stopped terminal stops no robot."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._poll = select.poll()
        self._poll.register(descriptor, select.POLLOUT)
        self.dropped = 0

    def write(self, line: str) -> None:
        data = line.encode(errors="replace")[: select.PIPE_BUF - 1] + b"\n"  # up to PIPE_BUF a write is all or nothing
        try:
            if self._poll.poll(0):
                os.write(self._descriptor, data)
                return
        except OSError:  # nobody reads there any more
            pass
        self.dropped += 1
