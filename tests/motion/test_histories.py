"""Histories against latch and arbiter, in CPython and in MicroPython; deliberate bugs show in short ones."""

from __future__ import annotations

import operator
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from tests.motion.histories import STEPS, generate, shortest, violation
from tests.motion.mutations import MUTATIONS, Mutation
from tests.motion.rules import PERSON, UNKNOWN_RUN
from tests.motion.world import CORES
from tests.support import cases, some

HISTORIES = cases(80_000, 300_000) // STEPS
WITH_BUG = 3_000_000 // STEPS  # at most, until it shows


def test_no_history_breaks_a_rule() -> None:
    broken = [(number, rule) for number in range(HISTORIES) if (rule := violation(generate(0, number)))]
    assert not broken, "python -m tests.motion.histories --seed 0 prints the shortest history"


@pytest.mark.parametrize("name", some(MUTATIONS, 4))
def test_each_deliberate_bug_shows_in_a_short_history(tmp_path: Path, name: str) -> None:
    with_bug, cores = MUTATIONS[name].load(tmp_path)
    found = (
        (history, rule)
        for history in (generate(0, number) for number in range(WITH_BUG))
        if (rule := violation(history, with_bug, cores))
    )
    history, rule = next(found)
    layout, steps = shortest(history, rule, with_bug, cores)
    assert rule.startswith("ViolatedError"), rule
    assert len(steps) <= 20, steps
    assert violation((layout, steps)) == "", "without the bug the rules hold"


def test_scripts_are_refused_twice_while_latched(tmp_path: Path) -> None:
    """A latch that ignores scripts changes nothing, from any state: their runs are barred before it is asked."""
    _, cores = Mutation("latch", "            return moves\n", "            return moves and not script\n").load(
        tmp_path
    )
    commands = [(False, UNKNOWN_RUN), *product((False, True), (PERSON, 1, 2, 3))]
    flags = product((False, True), repeat=6)
    for state in product(flags, (0, 1, 2, 3), (0, 1, 2, 3), commands, (-1, 0, 400), (0, 400, 5000)):
        assert _judged(cores, *state) == _judged(CORES, *state), state


def _judged(cores: Any, flags: tuple[bool, ...], barred: int, newest: int, command: Any, valid: int, now: int) -> Any:
    """The result of ``judge`` and the state after it, from any state."""
    latch = cores.Latch("00c0ffee", 4, operator.sub)
    arbiter = cores.Arbiter(latch, 0, operator.sub, 750)
    latch.latched, latch._waits, arbiter._starting, arbiter._held, arbiter._resumes, arbiter._scripted = flags
    arbiter.barred, arbiter._newest, arbiter._script_ms = barred, newest, 750
    result = arbiter.judge(*command, valid, now)
    return result, {**vars(arbiter), "latch": vars(latch)}
