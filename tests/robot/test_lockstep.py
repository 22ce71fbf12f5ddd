"""Random schedules of persons, scripts and faults in virtual time; deliberate bugs show in them.

``python -m tests.robot.lockstep`` runs thousands.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator

import pytest

from tests.robot.lockstep.mutations import MUTATIONS
from tests.robot.lockstep.schedules import first_violation, generate, violation
from tests.robot.lockstep.world import Folder
from tests.support import cases, some

SCHEDULES = cases(80, 150)


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    """What services log would take most of the time."""
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


def test_no_schedule_violates_a_rule() -> None:
    assert first_violation(0, SCHEDULES) is None, "python -m tests.robot.lockstep --seed 0 prints the shortest schedule"


@pytest.mark.parametrize("name", some(MUTATIONS, 4))
def test_each_deliberate_bug_shows(name: str) -> None:
    with MUTATIONS[name].applied():
        found = first_violation(1, 500, MUTATIONS[name].schedule)
    assert found is not None
    number, rule = found
    assert rule.startswith("ViolatedError"), rule
    assert violation(generate(1, number), Folder()) == "", "without the bug the rules hold"


def test_a_schedule_is_always_the_same() -> None:
    with MUTATIONS["a zero waits for its turn"].applied():
        found = [[violation(generate(1, number), Folder()) for number in range(10)] for _ in range(2)]
    assert found[0] == found[1]
    assert any(found[0])
