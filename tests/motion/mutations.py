"""Deliberate bugs in latch, arbiter and what is around them; a history must show each of them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from pebble.client import estop
from pebble.simulation.micropython.loader import firmware_root
from tests.kit.mutations import Mutation, in_copy
from tests.motion import world

_LATCH, _LEASE, _ARBITER, _TICKS = _CORES = tuple(f"common/{name}.py" for name in world.CORE_NAMES)
_MODULES = {"world": world.__file__, "estop": estop.__file__}


@contextmanager
def mutated(mutation: Mutation) -> Iterator[tuple[type[world.World], Any]]:
    """Yields the class World and the cores; the bug is in a module of the firmware, the sender, or the world."""
    if mutation.file not in _MODULES:
        with in_copy(mutation, firmware_root(), *_CORES) as folder:
            yield world.World, world.load_cores(folder)
        return
    path = Path(_MODULES[mutation.file])
    module = ModuleType(f"mutated_{mutation.file}")
    exec(compile(mutation.text(path), str(path), "exec"), module.__dict__)
    if mutation.file == "estop":
        yield world.World, world.load_cores(sender=module.StopSender)
    else:
        yield module.World, world.CORES


MUTATIONS = {
    "persons ignore the latch": Mutation(_LATCH, "        if self.latched:\n", "        if self.latched and script:\n"),
    "a reset of another life is obeyed": Mutation(_LATCH, '"boot" if boot != self.boot else ', ""),
    "a reset of an earlier count is obeyed": Mutation(_LATCH, '"count" if count != self.count else ', ""),
    "an old reset is obeyed": Mutation(_LATCH, "age >= 1000", "age >= 2000"),
    "a stop counts only while free": Mutation(
        _LATCH,
        "        self.latched = True\n        self.count += 1\n",
        "        self.count += not self.latched\n        self.latched = True\n",
    ),
    "the second stop of one name resets": Mutation(
        _LATCH,
        "            return False\n        senders =",
        "            self.latched = False\n        senders =",
    ),
    "names are not restored": Mutation(_LATCH, "if is_name(name)][: self.names]", "if not is_name(name)]"),
    "one name is remembered": Mutation(_LATCH, "[name] + self.recent", "[name]"),
    "one sender's stops take the places of others": Mutation(_LATCH, "senders.count(one), at", "0, at"),
    "a damaged file is free": Mutation(
        _LATCH, "            self.latched = True\n", "            self.latched = False\n"
    ),
    "after a reset persons drive on": Mutation(_LATCH, "self._waits = True", "self._waits = False"),
    "after a reset persons let go too shortly": Mutation(_LATCH, "_waits_from) >= 500", "_waits_from) >= 499"),
    "commands do not prolong the wait after a reset": Mutation(
        _LATCH, "        self._waits_from = now\n        return self._waits\n", "        return self._waits\n"
    ),
    "a barred run moves": Mutation(_ARBITER, "not newer(run, self.barred))", "not newer(run, self.barred - 1))"),
    "an older run moves": Mutation(_ARBITER, "            self.bar(run - 1 or LAST_RUN)\n", ""),
    "the newest run may fall": Mutation(_ARBITER, "if newer(run, self.barred) and", "if run > 0 and"),
    "a new run bars itself": Mutation(_ARBITER, "self.bar(run - 1 or LAST_RUN)", "self.bar(run)"),
    "numbers of runs end": Mutation(_ARBITER, "0 < (run - last) & LAST_RUN < 1 << 29", "run > last"),
    "the last run moves after run 1": Mutation(_ARBITER, "self.bar(run - 1 or LAST_RUN)", "self.bar(run - 1)"),
    "a stop bars nothing": Mutation(_ARBITER, "        self.bar(self._newest)\n        self._scripted = False\n", ""),
    "a run is not barred while latched": Mutation(_ARBITER, "            self.bar(run)\n", "            pass\n"),
    "the hold is too short": Mutation(_ARBITER, "HOLD_MS = 2000", "HOLD_MS = 1999"),
    "a start waits too shortly": Mutation(_ARBITER, "self._started) >= HOLD_MS", "self._started) >= HOLD_MS - 1"),
    "a script's zero takes the wheel from a person": Mutation(
        _ARBITER, "        if run == PERSON:\n", "        if run == PERSON or not moves:\n"
    ),
    "a final zero lets the run resume": Mutation(_ARBITER, "(final or self._scripted)", "self._scripted"),
    "a zero lets the run in effect resume": Mutation(_ARBITER, "(final or self._scripted)", "final"),
    "a lost connection lets the run resume": Mutation(
        _ARBITER, "self._resumes = not moves and not final", "self._resumes = True"
    ),
    "a release bars": Mutation(_ARBITER, "self._resumes = not moves and not final", "self._resumes = False"),
    "valid_ms has no effect": Mutation(_ARBITER, "else int(valid_ms)", "else self._watchdog_ms"),
    "valid_ms has no limit": Mutation(_ARBITER, "valid_ms < 0 or valid_ms > self._watchdog_ms", "valid_ms < 0"),
    "the key of before moves": Mutation(_LEASE, "            if key:\n                return True\n", ""),
    "a key stays when control passes on": Mutation(
        _LEASE, "self._random(4) if ms", "self.key or self._random(4) if ms"
    ),
    "a zero needs a key": Mutation(
        _LEASE, "        elif moves:\n            if key:", "        else:\n            if key:"
    ),
    "control never ends": Mutation(_LEASE, "diff(now, self._since) >= self._limit_ms or", "False or"),
    "everybody takes over": Mutation(_LEASE, "elif urgent or not self._held:", "elif True:"),
    "nobody takes over": Mutation(_LEASE, "elif urgent or not self._held:", "elif not self._held:"),
    "anybody releases": Mutation(
        _LEASE,
        "if client[:2] == self.holder[:2]:\n            self._end",
        "if self.key:\n            self._end",
    ),
    "the key of another account moves": Mutation(_LEASE, " and self.holder[:1] == (by,)", ""),
    "another account with the same id has control": Mutation(
        _LEASE,
        "if client[:2] == self.holder[:2]:\n            self._since",
        "if client[1:2] == self.holder[1:2]:\n            self._since",
    ),
    "strangers drive while somebody has control": Mutation(_LEASE, " or (self.strangers and self.key)", ""),
    "strangers are not refused": Mutation(_LEASE, "self.strangers == 2 or", ""),
    "programs of the robot are strangers": Mutation(_ARBITER, "run != PERSON or own", "run != PERSON"),
    "scripts elsewhere need no key": Mutation(_ARBITER, "if by and run != PERSON", "if False and run != PERSON"),
    "a zero of a script elsewhere is a script's": Mutation(
        _ARBITER, "            run = PERSON\n", "            pass\n"
    ),
    "scripts are strangers": Mutation(_ARBITER, "run != PERSON or own", "own"),
    "the last one who asks gets control": Mutation(
        _LEASE, "elif not self.asker or client[:2] == self.asker[:2]:", "else:"
    ),
    "who asks gets nothing": Mutation(
        _LEASE, "self.take(self.asker, self._wait if self.asker else 0, now)", "self.take((), 0, now)"
    ),
    "who asked once asks for ever": Mutation(_LEASE, "diff(now, self._asked) >= self._wait", "False"),
    "who drives counts as idle": Mutation(_LEASE, "                self._held = True\n", "                pass\n"),
    "who only holds is idle too late": Mutation(_LEASE, "self._held_from) >= 5000", "self._held_from) >= 6000"),
    "commands do not renew": Mutation(
        _LEASE, "            self._since = now\n            if moves:", "            if moves:"
    ),
    "control has no longest time": Mutation(_LEASE, "min(max(ms, 1000), 10_000)", "max(ms, 1000)"),
    "the wheels turn on when control passes on": Mutation(
        _LEASE, "self.changed = self.halts = True", "self.changed = True"
    ),
    "it is not shown that others drive": Mutation(_LEASE, "                self.others = True\n", ""),
    "a stranger's zero lets go after a reset": Mutation(_ARBITER, "if (moves or ours) and self", "if self"),
    "a stranger's zero lets the run resume": Mutation(_ARBITER, "valid_ms == 0 or not ours", "valid_ms == 0"),
    "what has no key of now begins a run": Mutation(
        _ARBITER,
        "return REFUSED\n        ours",
        "self._newest = max(run, self._newest)\n            return REFUSED\n        ours",
    ),
    "times do not wrap": Mutation(
        _TICKS, "return ahead if ahead < _HALF else ahead - _HALF - _HALF", "return now - since"
    ),
    "a zero is lost when it is replaced": Mutation("world", "if old is not None and not old[4]:", "if False:"),
    "a stop leaves a command in the slot": Mutation(
        "world", "        self.slot = None\n        self.until = 0\n", "        self.until = 0\n"
    ),
    "a stop leaves the wheels turning": Mutation(
        "world", "        self.slot = None\n        self.until = 0\n", "        self.slot = None\n"
    ),
    "saved is what is only renamed": Mutation(
        "world",
        "self.stage = RENAMED\n",
        "self.stage, self.saved_version = RENAMED, self.writing_version\n",
    ),
    "saved is what is only written": Mutation(
        "world", "self.stage = WRITTEN\n", "self.stage, self.saved_version = WRITTEN, self.version\n"
    ),
    "an older write counts as the newest": Mutation(
        "world", "self.saved_version = self.writing_version", "self.saved_version = self.version"
    ),
    "what an earlier process has renamed counts as saved": Mutation(
        "world", "            self.version = 1  #", "            self.version = 0  #"
    ),
    "a board counts a failed write": Mutation(
        "world", "return bool(self._latched_in_file() == self.latch.latched)\n", "return True\n"
    ),
    "every life has the same name": Mutation("world", "{self.boots:07x}", "0000000"),
    "a retained stop counts": Mutation("world", "if copy:", 'if copy and what != "stop":'),
    "a retained reset counts": Mutation("world", "if copy:", 'if copy and what != "reset":'),
    "a retained drive counts": Mutation("world", "if copy:", 'if copy and what != "drive":'),
    "a sender ignores owners that have not answered": Mutation(
        "estop", "for owner in self.estop.owners if (why", "for owner in self.estop.states if (why"
    ),
    "the answer of one owner confirms": Mutation(
        "estop", "and not self.unconfirmed:", "and len(self.unconfirmed) < len(self.estop.owners):"
    ),
    "a sender ignores whether it is saved": Mutation(
        "estop", "if self.estop.states[owner].persisted is False else", "if False else"
    ),
    "a sender takes any stop for its own": Mutation(
        "estop", "and self._order.name in state.recent", "and state.latched"
    ),
    "a hold repeats whenever its name is not listed": Mutation(
        "estop", "self._boots.get(owner) == state.boot", "self._lists_it(owner)"
    ),
    "a stop that cannot be saved counts as saved": Mutation("estop", "persisted is True", "persisted is not False"),
    "a sender repeats what is confirmed": Mutation("estop", "(Progress.WAITING, Progress.OLD)", "Progress"),
    "a sender does not repeat": Mutation(
        "estop",
        "self.next, self._names_due = now, now + REPEAT_S, False",
        'self.next, self._names_due = now, float("inf"), False',
    ),
    "a sender repeats without zeros": Mutation(
        "estop", "messages.append(_message(DRIVE,", "self.estop.old and messages.append(_message(DRIVE,"
    ),
    "a hold ends after 60 s": Mutation("estop", "if not self.order.hold and now >=", "if now >="),
    "a sender never gives up": Mutation(
        "estop", "if not self.order.hold and now >= self._began + GIVE_UP_S:", "if False:"
    ),
    "the number of a run is not saved": Mutation("world", "self.run = self.saved_run = max(", "self.run = max("),
    "the manager ignores a restart": Mutation("world", 'if state["latched"] or changed or', 'if state["latched"] or'),
}
