"""Histories against latch and arbiter, in CPython and in MicroPython."""

from __future__ import annotations

from tests.motion.histories import ENGINE, LENGTH
from tests.support import cases

HISTORIES = cases(80_000, 300_000) // LENGTH


def test_no_history_breaks_a_rule() -> None:
    broken = [one for one in ENGINE.run("", 0, range(HISTORIES)) if one.problems]
    assert not broken, "python -m tests.kit.schedules motion --seed 0 prints the shortest history"
