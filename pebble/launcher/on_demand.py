"""Programs that run only while another program requests them by notes to the launcher (pebble.runtime.notes)."""

import logging
from collections.abc import Iterable

from pebble.config.visible import shown
from pebble.extension import Program
from pebble.launcher.process_supervisor import ProcessSupervisor
from pebble.launcher.reactor import Reactor
from pebble.runtime.notes import Held, Wanted
from pebble.runtime.parent import ENCODING, WANTED

#: Requests of an ended program count for this long; by then its successor must have repeated them.
OUTLIVE_S = 5.0

log = logging.getLogger(__name__)


class OnDemand:
    """The requests in Wanted and Held notes: a program runs while it is wanted and not held. For one thread."""

    def __init__(self, reactor: Reactor, supervisors: Iterable[ProcessSupervisor]) -> None:
        self._reactor = reactor
        self._supervisors = {s.program.name: s for s in supervisors if s.program.on_demand}
        self._wanted: dict[str, bool] = {}  # what the newest Wanted note says, by the requested program
        self._held: dict[str, bool] = {}  # what the newest Held note says, by the program that it holds or frees
        self._encodings: dict[str, str] = {}  # with which a program begins, whenever it is started
        self._until: dict[str, float] = {}  # when a request expires whose sender has ended
        self._refused: set[str] = set()  # programs whose first refused note was logged

    @property
    def requested(self) -> tuple[str, ...]:
        return tuple(name for name in self._supervisors if self._wanted.get(name))

    def environment(self, program: Program) -> dict[str, str]:
        """Return a new process's variables: its last process's requests, or an on-demand program's encoding."""
        if program.may_request:
            return {WANTED: " ".join(f"{name}={self._encodings[name]}" for name in self.requested)}
        return {ENCODING: self._encodings[program.name]} if program.on_demand else {}

    def want(self, sender: Program, note: Wanted) -> None:
        """Request a program, or release it."""
        if not self._may(sender, note):
            return
        name, supervisor = note.program, self._supervisors[note.program]
        self._wanted[name] = note.on
        is_other_encoding = note.encoding != self._encodings.get(name, "")
        self._encodings[name] = note.encoding
        self._until.pop(name, None)
        if is_other_encoding and supervisor.requested and supervisor.policy.state != "ready":
            supervisor.release()  # a starting process would not receive the new encoding
        self._follow(name)

    def hold(self, sender: Program, note: Held) -> None:
        """End a program for a while, or let it run again if it is still wanted, as ``note`` says."""
        if self._may(sender, note):
            self._held[note.program] = note.on
            self._follow(note.program)

    def _follow(self, name: str) -> None:
        """Run the program, or end it for good or for a while, as the requests now say."""
        supervisor = self._supervisors[name]
        if not self._wanted.get(name):
            supervisor.release()
        elif self._held.get(name):
            supervisor.hold()
        else:
            supervisor.request()

    def ended(self, program: Program) -> None:
        """Note the end of a program. What it has requested runs for OUTLIVE_S longer, and what it holds runs again."""
        if not program.may_request:  # only the bridge may: all that is requested or held here is so by the same program
            return
        no_longer_held, self._held = self._held, {}
        for name in no_longer_held:
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
            self._wanted[name] = False
            self._follow(name)

    def _may(self, sender: Program, note: Wanted | Held) -> bool:
        """True if ``sender`` may request this program. The first refusal of each sender is logged."""
        may = sender.may_request and note.program in self._supervisors
        if not may and sender.name not in self._refused:
            self._refused.add(sender.name)
            log.warning("%s may not request %s, ignored", sender.name, shown(note.program))
        return may
