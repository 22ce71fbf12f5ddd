"""Judges, by processes' notes (pebble.runtime.notes), whether drive commands and stops reach the motors. Pure.

A judgement is a state, "no", "unknown" or "yes", with the reason unless it is "yes".
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from msgspec.structs import replace

from pebble.runtime.notes import OFTEN, Local, Mcu, Reach

_NO, _UNKNOWN, _YES = _STATES = "no", "unknown", "yes"  # the worst first

_WORDS = {"init": "starting"}  # of a process's state


def _shown(mcu: Mcu) -> dict[str, Any]:
    """Return the state of a serial line, in the form of the robot's status."""
    starts, why = mcu.starts or None, mcu.why or _starts(mcu) or None
    fields = {"state": mcu.state, "heard_ms": mcu.silent_ms, "starts_per_minute": starts, "why": why}
    return {name: value for name, value in fields.items() if value is not None}


def _starts(mcu: Mcu) -> str:
    times = "once" if mcu.starts == 1 else f"{mcu.starts} times"
    return f"its board has started again {times} within a minute" if mcu.starts else ""


def _drives(mcu: Mcu) -> tuple[str, str]:
    """Return the judgement of a board. Its silence is "unknown", unless it normally sends all the time (`Mcu`)."""
    match mcu.state:
        case "absent":
            return _NO, mcu.why or "there is no such device"
        case "silent":
            return _NO, "its board has stopped sending: it hangs, or has lost its power"
        case "booting":
            return _UNKNOWN, "its board is starting"
    if mcu.starts >= OFTEN:
        return _UNKNOWN, _starts(mcu)
    if mcu.silent_ms is None:
        return _UNKNOWN, mcu.why or "its board has sent nothing yet"
    return (_YES, "") if mcu.silent_ms < 10_000 else (_UNKNOWN, "its board has sent nothing for 10 s")


class Driveable:
    """The newest Mcu, Local and Reach notes of all programs; ``on_change()`` is called when the judgement may change.

    ``lines``: the name of each serial line by its program. ``owners``: the programs that drive motors. ``ways``: the
    programs through which drive commands reach the owners, and which must receive the owners' messages.
    """

    def __init__(
        self, lines: Mapping[str, str], owners: Iterable[str], ways: Iterable[str], on_change: Callable[[], None]
    ) -> None:
        self._lines, self._owners, self._ways = dict(lines), tuple(owners), tuple(ways)
        self._on_change = on_change
        self._mcus: dict[str, Mcu] = {}  # by program
        self._connected: dict[str, Local] = {}  # by program
        self._reached: dict[str, dict[str, bool]] = {}  # by program, and by the name of the line

    @property
    def mcus(self) -> dict[str, dict[str, Any]]:
        """States of the serial lines, by name, in the form of the robot's status."""
        return {name: _shown(self._mcus[program]) for program, name in self._lines.items() if program in self._mcus}

    def mcu(self, program: str, note: Mcu) -> None:
        """Handle a note about a serial line of ``program``."""
        if program not in self._lines:
            return
        before = self._mcus.get(program)
        self._mcus[program] = note
        if before is not None:
            is_same = replace(before, silent_ms=None) == replace(note, silent_ms=None)  # but for the silence
            if is_same and _drives(before) == _drives(note):  # nor does the silence change the judgement
                return
        self._on_change()

    def local(self, program: str, note: Local) -> None:
        """Handle a note about the connection of ``program`` to the robot's other processes."""
        self._connected[program] = note
        self._on_change()

    def reach(self, program: str, note: Reach) -> None:
        """Handle a note whether messages of a motor owner reach ``program``."""
        if note.owner in self._lines.values():
            self._reached.setdefault(program, {})[note.owner] = note.reached
            self._on_change()

    def ended(self, program: str) -> None:
        """Forget the notes of a program that has ended."""
        for table in (self._mcus, self._connected, self._reached):
            table.pop(program, None)

    def assessment(self, states: Mapping[str, str]) -> dict[str, str] | None:
        """Return the worst judgement, such as ``{"state": "no", "why": "serial: …"}``; None if there are no motors.

        ``states``: the states of all programs.
        """
        if not self._owners:
            return None
        judgements = [
            *(self._of_process(program, states.get(program, "stopped")) for program in (*self._owners, *self._ways)),
            *(self._of_line(program) for program in self._owners),
            *(self._of_way(way, self._lines[program]) for way in self._ways for program in self._owners),
        ]
        state, why = min(judgements, key=lambda judgement: _STATES.index(judgement[0]))
        return {"state": state, "why": why} if why else {"state": state}

    def _of_process(self, program: str, state: str) -> tuple[str, str]:
        if state != "ready":
            return _NO, f"{program} is {_WORDS.get(state, state)}"
        local = self._connected.get(program)
        if local is None:
            return _UNKNOWN, f"{program} has just started"
        why = local.why or "it does not reach the other programs"
        return (_YES, "") if local.connected else (_NO, f"{program}: {why}")

    def _of_line(self, program: str) -> tuple[str, str]:
        name = self._lines[program]
        state, why = _drives(self._mcus[program]) if program in self._mcus else (_UNKNOWN, "it has just started")
        return state, why and f"{name}: {why}"

    def _of_way(self, way: str, name: str) -> tuple[str, str]:
        reached = self._reached.get(way, {}).get(name)
        if reached is None:
            return _UNKNOWN, f"{way} has received nothing from {name} yet"
        return (_YES, "") if reached else (_NO, f"{way} receives nothing from {name}")
