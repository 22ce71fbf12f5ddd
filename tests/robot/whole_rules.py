"""What must be true of a whole robot's wheels and scripts, recomputed from what people did and what was published.

Persons drive forward, scripts backward or on the spot, so each line of the MCU shows whose it is. ``stalls`` are the
times in which the machine did not let processes run, or the MCU's stand-in by its own trace: a deadline is as much
later then. Wheels that turn for 1.00 s were stopped by the MCU, whose own dead-man's switch needs a second: the motor
owner did not write for as long.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pebble.contract.payloads import EstopState
from tests.kit.stalls import Stall, lost_s
from tests.support import gone

Wheels = tuple[float, float]
Lines = list[tuple[float, Wheels]]

_REST = (0.0, 0.0)
_DEADLINE_S, _DEADMAN_S, _BUSY_S = 0.75, 1.0, 0.15  # and what is not measured of a busy machine
_HOLD_S = 1.9  # of the two seconds for which a person's command holds a script
_REACTION_S = 0.5  # from a stop to wheels at rest
_HELPLESS_S = 1.2  # from a stop whose owner was killed or stands still
_UNSURE_S = 0.6  # before and after a fault, nothing is expected to arrive
_SAME_READ_S = 0.005  # lines of one read have one time
_LATE_S = 1.2  # until the kernel and the guard have ended the scripts of a manager that was killed
_OWNER_FAULTS = ("serial_mcu_bridge", "launcher", "power")
_NAMES = 4  # of stops, remembered by every owner


@dataclass(frozen=True, slots=True)
class Event:
    at: float
    what: str
    details: dict[str, Any] = field(default_factory=dict)


class History:
    """The events of one schedule, with their times (CLOCK_MONOTONIC)."""

    def __init__(self) -> None:
        self.began = time.monotonic()
        self._events: list[Event] = []

    def add(self, what: str, *, at: float | None = None, **details: Any) -> None:
        self._events.append(Event(time.monotonic() if at is None else at, what, details))

    def events(self, *what: str) -> list[Event]:
        """Return these events, or all, in the order of their times."""
        return sorted((event for event in self._events if not what or event.what in what), key=lambda event: event.at)


@dataclass(frozen=True)
class Seen:
    """What a schedule has shown. ``states``: of the motor owner, that arrived live; ``planted``: old stops' names."""

    history: History
    lines: Lines
    motors: Lines
    states: list[tuple[float, EstopState]]
    overlaps: list[tuple[float, list[int]]]
    speeds: Mapping[str, float]
    planted: set[str]

    def problems(self, stalls: Sequence[Stall] = ()) -> list[str]:
        """Return what does not hold, in words; empty if everything does."""
        faults = self.history.events("fault")
        return [
            *(f"{at:.3f}: two scripts are alive: {pids}" for at, pids in self.overlaps),
            *self._too_long(faults, stalls),
            *self._beside_persons(),
            *self._after_stops(faults, stalls),
            *self._while_latched(faults, stalls),
            *[f"{at:.3f}: a retained stop was obeyed" for at, s in self.states if self.planted & {*s.recent}][:1],
        ]

    def _too_long(self, faults: list[Event], stalls: Sequence[Stall]) -> Iterator[str]:
        """Find wheels that turn 0.75 s after the last command, or 1 s if the process that stops them could not."""
        for index, (at, wheels) in enumerate(self.lines):
            following = self.lines[index + 1][0] if index + 1 < len(self.lines) else float("inf")
            helpless = any(_may_affect(fault, at, at + _DEADLINE_S) and _of_owner(fault) for fault in faults)
            limit = at + _BUSY_S + (_DEADMAN_S if helpless else _DEADLINE_S)
            if wheels == _REST or following <= limit:
                continue
            stops = (when for when, turning in (*self.motors, *self.lines[index:]) if when >= at and turning == _REST)
            rest = min(stops, default=float("inf"))
            if rest > limit + lost_s(stalls, at, rest):
                yield f"{at:.3f}: the wheels turn for {rest - at:.2f} s after a command"

    def _beside_persons(self) -> Iterator[str]:
        """Find a script's line soon after a person's."""
        person = float("-inf")
        for at, wheels in self.lines:
            if by_person(wheels):
                person = at
            elif by_script(wheels) and _SAME_READ_S < at - person < _HOLD_S:
                yield f"{at:.3f}: a script moves the wheels {at - person:.2f} s after a person"

    def _after_stops(self, faults: list[Event], stalls: Sequence[Stall]) -> Iterator[str]:
        """Find what moves the wheels after a stop or a zero, before a person or a start commands anew."""
        starts = self.history.events("start")
        for stop in self.history.events("zero", "estop", "end", "manager killed"):
            of_person = self.speeds.get(stop.details.get("by", "")) if stop.what == "zero" else None
            unsure = stop.what != "manager killed" and any(_may_affect(fault, stop.at, stop.at) for fault in faults)
            if unsure or any(0 <= stop.at - start.at < _REACTION_S for start in starts):
                continue
            reaction = _LATE_S if stop.what == "manager killed" else _REACTION_S
            until = next((event.at for event in self.history.events("drives", "start") if event.at > stop.at), 1e99)
            ends_script = stop.what != "zero" or stop.details["final"]
            for at, wheels in self.lines:
                moves = (ends_script and by_script(wheels)) or (of_person is not None and wheels == (of_person,) * 2)
                if moves and stop.at + reaction + lost_s(stalls, stop.at, at) < at < until:
                    yield f"{at:.3f}: the wheels turn {wheels} {at - stop.at:.2f} s after {stop.what}"
                    break

    def _while_latched(self, faults: list[Event], stalls: Sequence[Stall]) -> Iterator[str]:
        """Find wheels that turn after a state that lists a stop, until a reset that could end it."""
        boots = list(dict.fromkeys(state.boot for _, state in self.states))
        resets = self.history.events("reset")
        for given in self.history.events("estop"):
            name = given.details["name"]
            for boot in boots:
                shown = [(at, s) for at, s in self.states if s.boot == boot and s.latched and name in s.recent]
                if not shown:
                    continue
                first, state = shown[0]
                ends = [one.at for one in resets if one.at >= given.at and _may_end(one, name, state, boots)]
                saved = next((at for at, state in shown if state.persisted is not False), float("inf"))
                deaths = [fault.at for fault in faults if _of_owner(fault) and first < fault.at < saved]
                helpless = any(_of_owner(fault) and _may_affect(fault, first, first) for fault in faults)
                since = first + (_HELPLESS_S if helpless else _REACTION_S)
                for at in self._turning(since, min([*ends, *deaths], default=float("inf"))):
                    if at > since + lost_s(stalls, first, at):
                        yield f"{at:.3f}: wheels turn {at - first:.2f} s after the state that lists stop {name}"
                        break

    def _turning(self, first: float, last: float) -> Iterator[float]:
        """Return since when motors turn, within this time."""
        ends = [at for at, _ in self.motors[1:]] + [float("inf")]
        for (at, wheels), end in zip(self.motors, ends, strict=False):
            if wheels != _REST and max(at, first) < min(end, last):
                yield max(at, first)


def by_person(wheels: Wheels) -> bool:
    return wheels[0] > 0 and wheels[1] > 0


def by_script(wheels: Wheels) -> bool:
    return wheels != _REST and not by_person(wheels)


def _may_affect(fault: Event, since: float, until: float) -> bool:
    return fault.at - _UNSURE_S < until and since < fault.details["until"] + _UNSURE_S


def _of_owner(fault: Event) -> bool:
    return str(fault.details["which"]).endswith(_OWNER_FAULTS)


def _may_end(reset: Event, name: str, latched: EstopState, boots: list[str]) -> bool:
    """True if the sender of this reset had seen a state with that stop, or a later one."""
    shown: EstopState = reset.details["shown"]
    if shown.boot == latched.boot:
        return name in shown.recent or shown.count >= latched.count + _NAMES
    return shown.boot in boots and boots.index(shown.boot) > boots.index(latched.boot)


_PERIOD_S = 0.01
_YOUNG_S = 1.0  # the environment of a process is its own only after exec


class Alive:
    """Looks every 10 ms for processes that have a config in ``folder`` in their environment, as scripts have."""

    def __init__(self, folder: Path) -> None:
        self._mark = b"PEBBLE_CONFIG=" + str(folder).encode()
        self._seen: dict[int, float] = {}  # processes that are no scripts, by when they were first seen
        self.overlaps: list[tuple[float, list[int]]] = []
        self.groups: set[int] = set()  # of scripts, at the last look
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(_PERIOD_S):
            self.look()

    def look(self) -> None:
        now = time.monotonic()
        with os.scandir("/proc") as entries:
            pids = {int(entry.name) for entry in entries if entry.name.isdigit()}
        self._seen = {pid: at for pid, at in self._seen.items() if pid in pids}
        groups: dict[int, int] = {}
        for pid in pids:
            if now - self._seen.get(pid, now) < _YOUNG_S and self._is_script(pid):
                self._seen.pop(pid, None)
                with suppress(ProcessLookupError):
                    groups[os.getpgid(pid)] = pid
            else:
                self._seen.setdefault(pid, now)
        if len(groups) > 1 and sum(not gone(pid) for pid in groups.values()) > 1:
            self.overlaps.append((now, sorted(groups.values())))
        self.groups = set(groups)

    def _is_script(self, pid: int) -> bool:
        try:
            return self._mark in Path(f"/proc/{pid}/environ").read_bytes() and not gone(pid)
        except OSError:
            return False
