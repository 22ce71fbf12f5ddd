"""Histories against latch and arbiter, in CPython and in MicroPython; deliberate bugs show in short ones."""

from __future__ import annotations

import operator
from itertools import product
from typing import Any

import pytest

from tests.kit.mutations import Mutation
from tests.motion.histories import ENGINE, LENGTH
from tests.motion.mutations import MUTATIONS, mutated
from tests.motion.rules import PERSON, UNKNOWN_RUN
from tests.motion.world import CORES, World
from tests.support import cases, some

HISTORIES = cases(80_000, 300_000) // LENGTH
WITH_BUG = 3_000_000 // LENGTH  # at most, until it shows


def test_no_history_breaks_a_rule() -> None:
    broken = [one for one in ENGINE.run("", 0, range(HISTORIES)) if one.problems]
    assert not broken, "python -m tests.kit.schedules motion --seed 0 prints the shortest history"


@pytest.mark.parametrize("name", some(MUTATIONS, 4))
def test_each_deliberate_bug_shows_in_a_short_history(name: str) -> None:
    found = ENGINE.find(name, 0, WITH_BUG)
    assert found is not None
    rule = found.problems[0]
    assert rule.startswith("ViolatedError"), rule
    with mutated(MUTATIONS[name]) as bug:
        layout, steps = ENGINE.shortest(ENGINE.draw("", 0, found.number), rule, bug=bug)
    assert len(steps) <= 20, steps
    assert ENGINE.violation((World, CORES), (layout, steps)) == "", "without the bug the rules hold"


def test_scripts_are_refused_twice_while_latched() -> None:
    """A latch that ignores scripts changes nothing, from any state: their runs are barred before it is asked."""
    ignoring = Mutation("common/latch.py", "            return moves\n", "            return moves and not script\n")
    commands = [(False, UNKNOWN_RUN), *product((False, True), (PERSON, 1, 2, 3))]
    flags = product((False, True), repeat=6)
    with mutated(ignoring) as (_, cores):
        for state in product(flags, (0, 1, 2, 3), (0, 1, 2, 3), commands, (-1, 0, 400), (0, 400, 5000)):
            assert _judged(cores, *state) == _judged(CORES, *state), state


def _judged(cores: Any, flags: tuple[bool, ...], barred: int, newest: int, command: Any, valid: int, now: int) -> Any:
    """The result of ``judge`` and the state after it, from any state."""
    latch = cores.Latch("00c0ffee", 4, operator.sub)
    arbiter = cores.Arbiter(latch, cores.Lease(0, operator.sub, str, 0), 0, operator.sub, 750)
    latch.latched, latch._waits, arbiter._starting, arbiter._held, arbiter._resumes, arbiter._scripted = flags
    arbiter.barred, arbiter._newest, arbiter._script_ms = barred, newest, 750
    result = arbiter.judge(*command, valid, now)
    return result, {**vars(arbiter), "latch": vars(latch), "lease": None}
