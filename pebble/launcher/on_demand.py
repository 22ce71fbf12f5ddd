"""The programs that run only while they are wanted: who may want them, and what becomes of the wants of the dead."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Mapping

from pebble.launched import ENCODING, WANTED
from pebble.launcher.keeper import Keeper
from pebble.launcher.program import Program
from pebble.launcher.reactor import Reactor

#: What a program wanted counts for this long after its end; then whoever replaced it has to have said it again.
OUTLIVE_S = 5.0

_want = re.compile(r"WANT (\S{1,64}) ([01])(?: ([a-z0-9]{1,16}))?", re.ASCII).fullmatch

log = logging.getLogger(__name__)


class OnDemand:
    """Hears ``WANT <program> 1|0 [encoding]`` from the program that may say it, and tells the keepers. One thread's."""

    def __init__(self, reactor: Reactor, keepers: Mapping[str, Keeper]) -> None:
        self._reactor, self._keepers = reactor, keepers
        self._encodings: dict[str, str] = {}  # that a program is to begin with, whenever it is started
        self._until: dict[str, float] = {}  # wanted by somebody who has ended since
        self._complained: set[str] = set()

    @property
    def wanted(self) -> tuple[str, ...]:
        return tuple(name for name, keeper in self._keepers.items() if keeper.wanted)

    def environment(self, program: Program) -> dict[str, str]:
        """What a new process of ``program`` is to know of all this."""
        if program.asks:
            return {WANTED: " ".join(f"{name}={self._encodings[name]}" for name in self.wanted)}
        return {ENCODING: self._encodings[program.name]} if program.on_demand else {}

    def hear(self, speaker: Program, line: str) -> None:
        """A note of ``speaker`` that is no sign of life."""
        said = _want(line)
        keeper = self._keepers.get(said[1]) if said else None
        if said is None or keeper is None or not speaker.asks:
            self._complain(speaker, line)
            return
        encoding = said[3] or ""
        changed = encoding != self._encodings.get(said[1], "")
        self._encodings[said[1]] = encoding
        self._until.pop(said[1], None)
        if said[2] == "0" or (changed and keeper.wanted and keeper.life.state != "ready"):
            keeper.unwant()  # one that still starts would not hear that it is to begin with something else
        if said[2] == "1":
            keeper.want()

    def ended(self, speaker: Program) -> None:
        """Nobody watches over what ``speaker`` wanted: it may go on for a while, but not for ever."""
        if not speaker.asks or not self.wanted:
            return
        due = time.monotonic() + OUTLIVE_S
        for name in self.wanted:
            self._until.setdefault(name, due)
        self._reactor.at(due, self._withdraw)

    def _withdraw(self) -> None:
        now = time.monotonic()
        for name in [name for name, due in self._until.items() if due <= now]:
            del self._until[name]
            log.warning("%s: who wanted it has ended, and nobody has wanted it again", name)
            self._keepers[name].unwant()

    def _complain(self, speaker: Program, line: str) -> None:
        if speaker.name not in self._complained:
            self._complained.add(speaker.name)
            log.warning("%s says what it has no say in, ignored: %.80s", speaker.name, line)
