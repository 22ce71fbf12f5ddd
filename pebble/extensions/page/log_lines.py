"""The newest log lines of one component, numbered, so that a page notices missing ones. Pure."""

import secrets
from collections import deque
from typing import Any, Final, NamedTuple

import msgspec

from pebble.contract import LOGS, codec
from pebble.errors import PayloadError

MAX_LINES: Final = 500  # of one component; the oldest goes
MAX_BYTES: Final = 256 * 1024  # of all lines together
MAX_LINE_BYTES: Final = 16 * 1024  # of one line
PART_BYTES: Final = 16 * 1024  # of one message to a page: echoes, without which it does not drive, wait behind it
_TEXT, _WORD = 4000, 64  # characters of a line, and of its level and service
_LATEST_MS = 8.6e15  # the latest time that browsers can show
_TEXTS = {"message", "msg"}
_SYNONYMS = {"WARN": "WARNING", "ERR": "ERROR", "FATAL": "CRITICAL", "TRACE": "DEBUG", "NOTICE": "INFO"}


class Run(NamedTuple):
    """A sequence of consecutive lines; ``first`` is the number of the first one."""

    first: int
    lines: tuple[msgspec.Raw, ...]


class LogLines:
    """Numbered log lines. ``origin`` changes when numbering restarts, as when a component is opened again."""

    def __init__(self) -> None:
        self.origin = secrets.token_hex(4)
        self._lines: deque[tuple[int, msgspec.Raw]] = deque()
        self._bytes = 0
        self._number = 0  # of the newest line, with those that were dropped

    def add(self, payload: bytes) -> None:
        """Add a payload of the log topic. A line that cannot be shown counts as dropped."""
        self._number += 1
        line = line_of(payload)
        if line is None:
            return
        self._lines.append((self._number, line))
        self._bytes += len(bytes(line))
        while len(self._lines) > MAX_LINES or self._bytes > MAX_BYTES:
            self._bytes -= len(bytes(self._lines.popleft()[1]))

    def after(self, number: int) -> Run | None:
        """Return the oldest lines after this number, as many as one message may have; None if there are none.

        They end before a number that is missing because its line was dropped.
        """
        run: list[msgspec.Raw] = []
        first = size = 0
        for line_number, line in self._lines:
            if line_number <= number:
                continue
            size += len(bytes(line))
            if not run:
                first = line_number
            elif line_number != first + len(run) or size > PART_BYTES:
                break
            run.append(line)
        return Run(first, tuple(run)) if run else None


class LogReader:
    """A page's place in the lines of the component that it watches. Each time it answers a ping, it gets more lines."""

    def __init__(self) -> None:
        self._on = False  # the page wants lines
        self._due = False  # the page has received the part before
        self._origin, self._number = "", 0  # of the last line that was sent

    def begin(self, origin: str, number: int, *, on: bool) -> None:
        """Note that the page has the lines up to ``number``; ``on`` False: it wants no more."""
        self._on, self._due = on, True
        self._origin, self._number = origin, number

    def end(self) -> None:
        self._on = False

    def echoed(self) -> None:
        self._due = True

    def take(self, lines: LogLines) -> Run | None:
        """Return the lines to send now; they count as received from now on."""
        if not self._on or not self._due:
            return None
        if self._origin != lines.origin:
            self._origin, self._number = lines.origin, 0
        run = lines.after(self._number)
        if run is not None:
            self._number, self._due = run.first + len(run.lines) - 1, False
        return run


class Line(msgspec.Struct, omit_defaults=True):
    """A line in the form for pages. ``t``: epoch milliseconds.

    It is made of a robot's message, which may be plain text, or have fields with other names.
    """

    message: str
    t: float | None = None
    level: str = ""
    service: str = ""


def line_of(payload: bytes) -> msgspec.Raw | None:
    """Return the line as JSON; None if it is too long."""
    if len(payload) > MAX_LINE_BYTES:
        return None
    try:
        plain = codec.plain(LOGS, payload)
    except PayloadError:
        plain = payload.decode(errors="replace")
    raw = msgspec.json.encode(_line(plain))
    return msgspec.Raw(raw) if len(raw) <= MAX_LINE_BYTES else None


def _line(plain: Any) -> Line:
    """Return a log message, of any form, as a line."""
    record = plain if isinstance(plain, dict) else {"message": plain}
    has_text = not _TEXTS.isdisjoint(record)
    if not has_text and isinstance(record.get("value"), dict):
        record = record | record["value"]  # {"t": …, "value": {"message": …}}
    text = next((record[name] for name in ("message", "msg", "value") if name in record), record)
    service = _word(record.get("service"))
    message = _text(text).removeprefix(f"[{service}] " if service else "")  # pages show the service apart
    level = _word(record.get("level")).upper()
    return Line(message, _stamp(record), _SYNONYMS.get(level, level), service)


def _word(value: object) -> str:
    return value[:_WORD] if isinstance(value, str) else ""


def _text(value: object) -> str:
    if value is None:
        return ""
    text = value if isinstance(value, str) else msgspec.json.encode(value).decode()
    return text if len(text) <= _TEXT else f"{text[:_TEXT]}…"


def _stamp(record: dict[str, Any]) -> float | None:
    """Return the time of a log message in epoch milliseconds; None if it has none that can be shown."""
    for name, per_ms in (("t", 1), ("timestamp", 1000)):
        stamp = record.get(name)
        if isinstance(stamp, int | float) and not isinstance(stamp, bool):
            return stamp * per_ms if 0 < stamp * per_ms < _LATEST_MS else None
    return None
