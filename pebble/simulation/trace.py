"""A record of what the host sent to a simulated MCU, and when."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal

import msgspec

_KEPT = 100_000  # entries in memory; a file keeps all

Event = Literal["plugged", "opened", "line", "closed", "unplugged"]


@dataclass(frozen=True, slots=True)
class Entry:
    """One line from the host, or a change of the link. ``ns`` is time.monotonic_ns() when its last byte arrived."""

    ns: int
    event: Event
    line: str = ""

    @property
    def drive(self) -> tuple[float, float] | None:
        """Left and right speed, if this is a well-formed drive line."""
        tokens = self.line.split(" ")
        if len(tokens) != 3 or tokens[0] != "M":
            return None
        try:
            return float(tokens[1]), float(tokens[2])
        except ValueError:
            return None


class Trace:
    """Entries in the order of arrival; with ``path`` also one JSON object per line in a file, written at once."""

    def __init__(self, path: Path | None = None) -> None:
        self._entries: deque[Entry] = deque(maxlen=_KEPT)
        self._file: BinaryIO | None = path.open("ab", buffering=0) if path is not None else None

    def add(self, entry: Entry) -> None:
        self._entries.append(entry)
        if self._file is not None:
            self._file.write(msgspec.json.encode(entry) + b"\n")

    def entries(self) -> list[Entry]:
        """A copy, oldest first."""
        return list(self._entries.copy())

    def lines(self) -> list[str]:
        """Only the lines, oldest first."""
        return [entry.line for entry in self.entries() if entry.event == "line"]

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None


def read_trace(path: Path) -> list[Entry]:
    """The entries of a trace file; a line that is just being written is left out."""
    raw = path.read_bytes()
    return [msgspec.json.decode(line, type=Entry) for line in raw[: raw.rfind(b"\n") + 1].splitlines()]
