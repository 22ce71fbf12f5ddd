"""A record of a simulated MCU's input and output and of its motors' changes, with times."""

from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal

import msgspec

from pebble.errors import DeviceError

_RETAINED = 100_000  # entries in memory; a file has all of them

Event = Literal["plugged", "opened", "line", "closed", "unplugged", "motors", "said", "late"]


@dataclass(frozen=True, slots=True)
class Entry:
    """A line from the host or (``said``) to it, or a change of the port or of the motors.

    ``ns`` is time.monotonic_ns() when the line's last byte was received, just before it was written, or when the
    outputs changed. The line of ``motors`` is ``<left> <right>`` with three decimals, -1..1, + = forward of the robot,
    however its motors are mounted. The line of ``late`` is the number of seconds until now in which a busy machine kept
    the MCU from reading its port: the lines that follow may have been sent at any time in these seconds.
    """

    ns: int
    event: Event
    line: str = ""

    @property
    def drive(self) -> tuple[float, float] | None:
        """Left and right speed, if this is a well-formed drive line."""
        tokens = self.line.split(" ")
        return _pair(tokens[1:]) if tokens[0] == "M" else None

    @property
    def motors(self) -> tuple[float, float] | None:
        """New speeds of the motors, left and right, -1..1; None for other entries."""
        return _pair(self.line.split(" ")) if self.event == "motors" else None

    @property
    def late_s(self) -> float:
        """Seconds for which the MCU did not read its port until now; 0 for other entries."""
        return float(self.line) if self.event == "late" else 0.0


def _pair(tokens: list[str]) -> tuple[float, float] | None:
    if len(tokens) != 2:
        return None
    try:
        return float(tokens[0]), float(tokens[1])
    except ValueError:
        return None


def motors_entry(ns: int, motors: tuple[float, float]) -> Entry:
    left, right = (round(speed, 3) + 0.0 for speed in motors)  # + 0.0: no "-0.000"
    return Entry(ns, "motors", f"{left:.3f} {right:.3f}")


class Trace:
    """Entries in the order of their arrival; with ``path`` also a file, with one JSON object per line, unbuffered.

    Raises DeviceError if the file cannot be opened.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._entries: deque[Entry] = deque(maxlen=_RETAINED)
        try:
            self._file: BinaryIO | None = path.open("ab", buffering=0) if path is not None else None
        except OSError as error:
            raise DeviceError(f"{error.filename}: {error.strerror}") from None

    def add(self, entry: Entry) -> None:
        self._entries.append(entry)
        if self._file is not None:
            self._file.write(msgspec.json.encode(entry) + b"\n")

    def entries(self) -> list[Entry]:
        """Return a copy of the entries, oldest first."""
        return list(self._entries.copy())

    def lines(self) -> list[str]:
        """Return the lines of the entries, oldest first."""
        return [entry.line for entry in self.entries() if entry.event == "line"]

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None


def read_trace(path: Path) -> list[Entry]:
    """Read the entries of a trace file."""
    return [msgspec.json.decode(line, type=Entry) for line in complete_lines(path)[0]]


def complete_lines(path: Path, start: int = 0) -> tuple[list[bytes], int]:
    """Return the complete lines of a file from byte ``start`` on, and the place where an incomplete line begins."""
    with path.open("rb") as file:
        file.seek(start)
        raw = file.read()
    end = raw.rfind(b"\n") + 1
    return raw[:end].splitlines(), start + end
