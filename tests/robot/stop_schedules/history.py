"""What happened in one schedule: events with their times (CLOCK_MONOTONIC), and what the wheels did."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from pebble.extensions.lab.simulation.trace import Entry, complete_lines


@dataclass(frozen=True, slots=True)
class Event:
    at: float
    what: str
    robot: str = ""
    details: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Turning:
    """The wheels have turned with ``speed`` (-1..1, + = forward) since ``at``; 0: they are still."""

    at: float
    speed: float


class History:
    """Any thread adds events."""

    def __init__(self) -> None:
        self.began = time.monotonic()
        self._events: list[Event] = []
        self._lock = threading.Lock()

    def add(self, what: str, robot: str = "", *, at: float | None = None, **details: Any) -> float:
        """Returns the time of the event."""
        event = Event(time.monotonic() if at is None else at, what, robot, details)
        with self._lock:
            self._events.append(event)
        return event.at

    def events(self, what: str = "", robot: str = "") -> list[Event]:
        """The events in the order of their times."""
        with self._lock:
            found = [e for e in self._events if what in ("", e.what) and robot in ("", e.robot)]
        return sorted(found, key=lambda event: event.at)


class Wheels:
    """Reads a growing trace of motors."""

    def __init__(self, trace: Path) -> None:
        self._trace, self._offset = trace, 0
        self._turned: list[Turning] = [Turning(0.0, 0.0)]

    def powered_off(self, at: float) -> None:
        """The motors' process was killed: its trace does not say that they are off."""
        self.read()
        self._turned.append(Turning(at, 0.0))

    def read(self) -> list[Turning]:
        """All changes since the last :meth:`forget`, and the state before."""
        lines, self._offset = complete_lines(self._trace, self._offset)
        for line in lines:
            entry = msgspec.json.decode(line, type=Entry)
            if entry.motors is not None:
                self._turned.append(Turning(entry.ns / 1e9, sum(entry.motors) / 2))
        return list(self._turned)

    def forget(self) -> None:
        self._turned = self.read()[-1:]

    @property
    def speed(self) -> float:
        return self.read()[-1].speed

    def turned(self, first: float, last: float) -> list[tuple[float, float, float]]:
        """``(from, to, speed)`` of each time within the two during which wheels turned."""
        changes = self.read()
        ends = [change.at for change in changes[1:]] + [float("inf")]
        return [
            (max(change.at, first), min(end, last), change.speed)
            for change, end in zip(changes, ends, strict=True)
            if change.speed and max(change.at, first) < min(end, last)
        ]
