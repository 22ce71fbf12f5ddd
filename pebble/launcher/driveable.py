"""Whether drive commands, and stops, reach the robot's motors, as far as its processes can tell. Pure."""

import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

_NO, _UNKNOWN, _YES = "no", "unknown", "yes"  # the worst one first

_WORDS = {"init": "starting"}  # of a process's state

_mcu = re.compile(r"MCU (absent|booting|ready|silent) (-|0|1000|10000)(?: (.{1,200}))?").fullmatch
_local = re.compile(r"LOCAL ([01])(?: (.{1,200}))?").fullmatch
_reach = re.compile(r"(REACHES|MISSES) ([^ ]{1,64})").fullmatch


class Mcu(NamedTuple):
    """A serial line. ``silent``: its board used to send all the time, and has stopped."""

    state: str
    silent_ms: int | None  # how long ago its board sent anything: 0, 1000 or 10000, at least; None: never since opening
    why: str = ""  # it is absent, or was never heard

    @property
    def shown(self) -> dict[str, Any]:
        """The value is that of the status."""
        age = {} if self.silent_ms is None else {"heard_ms": self.silent_ms}
        return {"state": self.state, **age, **({"why": self.why} if self.why else {})}

    @property
    def drives(self) -> tuple[str, str]:
        """A board that is silent by design at rest cannot be told from a dead one."""
        match self.state:
            case "absent":
                return _NO, self.why or "there is no such device"
            case "silent":
                return _NO, "its board has stopped sending: it hangs, or has lost its power"
            case "booting":
                return _UNKNOWN, "its board is starting"
        if self.silent_ms is None:
            return _UNKNOWN, self.why or "its board has sent nothing yet"
        return (_YES, "") if self.silent_ms < 10_000 else (_UNKNOWN, "its board has sent nothing for 10 s")


class Driveable:
    """Handles the notes MCU, LOCAL, REACHES and MISSES; ``on_change()`` is called when the status must follow.

    ``lines``: the name of each serial line by its program. ``owners``: those of the programs that drive motors.
    ``ways``: the programs that bring drive commands to them; they must receive what the owners publish.
    """

    def __init__(
        self, lines: Mapping[str, str], owners: Iterable[str], ways: Iterable[str], on_change: Callable[[], None]
    ) -> None:
        self._lines, self._owners, self._ways = dict(lines), tuple(owners), tuple(ways)
        self._on_change = on_change
        self._mcus: dict[str, Mcu] = {}  # by program, as all of these
        self._connected: dict[str, tuple[bool, str]] = {}
        self._reached: dict[str, dict[str, bool]] = {}  # then by the line's name

    @property
    def mcus(self) -> dict[str, dict[str, Any]]:
        """What is known of each serial line, by its name."""
        return {name: self._mcus[program].shown for program, name in self._lines.items() if program in self._mcus}

    def receive(self, program: str, line: str) -> bool:
        """Handle a note of ``program``; False if it is none of these."""
        if match := _mcu(line):
            if program in self._lines:
                self._set_mcu(program, Mcu(match[1], None if match[2] == "-" else int(match[2]), match[3] or ""))
        elif match := _local(line):
            self._connected[program] = match[1] == "1", match[2] or ""
            self._on_change()
        elif match := _reach(line):
            if match[2] in self._lines.values():
                self._reached.setdefault(program, {})[match[2]] = match[1] == "REACHES"
                self._on_change()
        else:
            return False
        return True

    def ended(self, program: str) -> None:
        for table in (self._mcus, self._connected, self._reached):
            table.pop(program, None)

    def assessment(self, states: Mapping[str, str]) -> dict[str, str] | None:
        """``{"state": "no", "why": "serial: …"}`` by the worst that is known; None: the robot has no motors.

        ``states`` are those of all programs.
        """
        if not self._owners:
            return None
        found = [
            *(self._of_process(program, states.get(program, "stopped")) for program in (*self._owners, *self._ways)),
            *(self._of_line(program) for program in self._owners),
            *(self._of_way(way, self._lines[program]) for way in self._ways for program in self._owners),
        ]
        state, why = min(found, key=lambda one: (_NO, _UNKNOWN, _YES).index(one[0]))
        return {"state": state, "why": why} if why else {"state": state}

    def _of_process(self, program: str, state: str) -> tuple[str, str]:
        if state != "ready":
            return _NO, f"{program} is {_WORDS.get(state, state)}"
        connected, why = self._connected.get(program, (None, ""))
        if connected is None:
            return _UNKNOWN, f"{program} has just started"
        return (_YES, "") if connected else (_NO, f"{program}: {why or 'it does not reach the other programs'}")

    def _of_line(self, program: str) -> tuple[str, str]:
        name = self._lines[program]
        state, why = self._mcus[program].drives if program in self._mcus else (_UNKNOWN, "it has just started")
        return state, why and f"{name}: {why}"

    def _of_way(self, way: str, name: str) -> tuple[str, str]:
        reached = self._reached.get(way, {}).get(name)
        if reached is None:
            return _UNKNOWN, f"{way} has received nothing from {name} yet"
        return (_YES, "") if reached else (_NO, f"{way} receives nothing from {name}")

    def _set_mcu(self, program: str, mcu: Mcu) -> None:
        before, self._mcus[program] = self._mcus.get(program), mcu
        if (
            before is None
            or before._replace(silent_ms=None) != mcu._replace(silent_ms=None)
            or before.drives != mcu.drives
        ):
            self._on_change()
