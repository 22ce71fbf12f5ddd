"""The newest log lines of one component, numbered, so that a page sees which are missing. Pure."""

import secrets
from collections import deque
from typing import Final, NamedTuple

import msgspec

from pebble.contract import LOGS, codec
from pebble.errors import PayloadError

MAX_LINES: Final = 500  # of one component; the oldest goes
MAX_BYTES: Final = 256 * 1024  # of all lines together
MAX_LINE_BYTES: Final = 16 * 1024  # of one line
PART_BYTES: Final = 16 * 1024  # of one message to a page: echoes, without which it does not drive, wait behind it


class Run(NamedTuple):
    """Lines that follow each other; ``first`` is the number of the first one."""

    first: int
    lines: tuple[msgspec.Raw, ...]


class LogLines:
    """``origin`` names this count of lines: another one begins when the component is opened anew."""

    def __init__(self) -> None:
        self.origin = secrets.token_hex(4)
        self._lines: deque[tuple[int, msgspec.Raw]] = deque()
        self._bytes = 0
        self._number = 0  # of the newest line, with those that were dropped

    def add(self, payload: bytes) -> None:
        """Take a payload of the log topic; one that cannot be shown counts as dropped."""
        self._number += 1
        line = line_of(payload)
        if line is None:
            return
        self._lines.append((self._number, line))
        self._bytes += len(bytes(line))
        while len(self._lines) > MAX_LINES or self._bytes > MAX_BYTES:
            self._bytes -= len(bytes(self._lines.popleft()[1]))

    def after(self, number: int) -> Run | None:
        """The oldest lines behind this number, as many as one message may have; None if there are none."""
        run: list[msgspec.Raw] = []
        first = size = 0
        for at, line in self._lines:
            if at <= number:
                continue
            size += len(bytes(line))
            if run and (at != first + len(run) or size > PART_BYTES):
                break
            first = first or at
            run.append(line)
        return Run(first, tuple(run)) if run else None


class LogReader:
    """How far one page has read the lines of the component that it watches: one part at each echo."""

    def __init__(self) -> None:
        self._on = self._due = False  # due: the page has received the part before
        self._sent = "", 0  # the origin and number of the last line

    def begin(self, origin: str, number: int, *, on: bool) -> None:
        """The page has lines until this one; ``on`` False: it wants no more."""
        self._on, self._sent, self._due = on, (origin, number), True

    def end(self) -> None:
        self._on = False

    def echoed(self) -> None:
        self._due = True

    def take(self, lines: LogLines) -> Run | None:
        """What to send now; it counts as received from now on."""
        if not (self._on and self._due):
            return None
        origin, number = self._sent
        run = lines.after(number if origin == lines.origin else 0)
        if run is not None:
            self._sent, self._due = (lines.origin, run.first + len(run.lines) - 1), False
        return run


def line_of(payload: bytes) -> msgspec.Raw | None:
    """The line as JSON: some robots send plain text. None if it is too long."""
    if len(payload) > MAX_LINE_BYTES:
        return None
    try:
        codec.plain(LOGS, payload)
        payload = codec.trim(payload)
    except PayloadError:
        payload = msgspec.json.encode(payload.decode(errors="replace"))
    return msgspec.Raw(payload) if len(payload) <= MAX_LINE_BYTES else None
