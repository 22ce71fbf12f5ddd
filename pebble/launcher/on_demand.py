"""Programs that run only while they are requested: which program may request them, and what follows from its exit."""

import logging
import re
from collections.abc import Iterable

from pebble.launcher.process_supervisor import ProcessSupervisor
from pebble.launcher.programs import Program
from pebble.launcher.reactor import Reactor
from pebble.runtime.parent import ENCODING, WANTED

#: Requests of a program that has ended count for this long; then its successor must have repeated them.
OUTLIVE_S = 5.0

_request = re.compile(r"WANT (\S{1,64}) ([01])(?: ([a-z0-9]{1,16}))?", re.ASCII).fullmatch
_hold = re.compile(r"HOLD (\S{1,64}) ([01])", re.ASCII).fullmatch

log = logging.getLogger(__name__)


class OnDemand:
    """Handles ``WANT <program> 1|0 [encoding]`` and ``HOLD <program> 1|0`` from a program that may request others.

    One that is requested does not run while it is held. For one thread only.
    """

    def __init__(self, reactor: Reactor, supervisors: Iterable[ProcessSupervisor]) -> None:
        self._reactor = reactor
        self._supervisors = {s.program.name: s for s in supervisors if s.program.on_demand}
        self._wanted: set[str] = set()
        self._held: set[str] = set()
        self._encodings: dict[str, str] = {}  # that a program is to begin with, whenever it is started
        self._until: dict[str, float] = {}  # when requests of a program that has ended expire
        self._refused: set[str] = set()  # programs whose first refused line has been logged

    @property
    def requested(self) -> tuple[str, ...]:
        return tuple(name for name in self._supervisors if name in self._wanted)

    def environment(self, program: Program) -> dict[str, str]:
        """The variables that pass requests on to a new process of ``program``."""
        if program.may_request:
            return {WANTED: " ".join(f"{name}={self._encodings[name]}" for name in self.requested)}
        return {ENCODING: self._encodings[program.name]} if program.on_demand else {}

    def receive(self, sender: Program, line: str) -> None:
        """Handle a note of ``sender`` that is no sign of life."""
        found = _request(line) or _hold(line)
        supervisor = self._supervisors.get(found[1]) if found else None
        if found is None or supervisor is None or not sender.may_request:
            self._refuse(sender, line)
            return
        name, on = found[1], found[2] == "1"
        if line.startswith("HOLD "):
            (self._held.add if on else self._held.discard)(name)
        else:
            self._note(name, on, found[3] or "", supervisor)
        self._follow(name)

    def _note(self, name: str, wanted: bool, encoding: str, supervisor: ProcessSupervisor) -> None:
        """A program is requested, or released."""
        (self._wanted.add if wanted else self._wanted.discard)(name)
        changed = encoding != self._encodings.get(name, "")
        self._encodings[name] = encoding
        self._until.pop(name, None)
        if changed and supervisor.requested and supervisor.policy.state != "ready":
            supervisor.release()  # one that still starts would not receive the new encoding

    def _follow(self, name: str) -> None:
        supervisor = self._supervisors[name]
        if name not in self._wanted:
            supervisor.release()
        elif name in self._held:
            supervisor.hold()
        else:
            supervisor.request()

    def ended(self, program: Program) -> None:
        """A program has ended: what it requested may run on for a while, but not for ever; it holds nothing more."""
        if not program.may_request:
            return
        held, self._held = self._held, set()
        for name in held:
            self._follow(name)
        if not self.requested:
            return
        due = self._reactor.now() + OUTLIVE_S
        for name in self.requested:
            self._until.setdefault(name, due)
        self._reactor.at(due, self._expire)

    def _expire(self) -> None:
        now = self._reactor.now()
        for name in [name for name, due in self._until.items() if due <= now]:
            del self._until[name]
            log.warning("%s: the program that requested it has ended, and the request was not repeated", name)
            self._wanted.discard(name)
            self._follow(name)

    def _refuse(self, sender: Program, line: str) -> None:
        if sender.name not in self._refused:
            self._refused.add(sender.name)
            log.warning("%s may not request this, ignored: %.80s", sender.name, line)
