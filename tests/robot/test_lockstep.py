"""Random schedules of persons, scripts and faults in virtual time; deliberate bugs show in them.

``python -m tests.kit.schedules lockstep`` runs thousands.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator

import pytest

from tests.kit.mutations import in_process
from tests.robot.lockstep.schedules import ENGINE
from tests.support import cases, some

SCHEDULES = cases(40, 150)


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    """What services log would take most of the time."""
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


def _violations(seed: int, numbers: Iterable[int]) -> list[str]:
    return [rule for one in ENGINE.run("", seed, numbers) for rule in one.problems]


def test_no_schedule_violates_a_rule() -> None:
    found = _violations(0, range(SCHEDULES))
    assert not found, "python -m tests.kit.schedules lockstep --seed 0 prints the shortest schedule"


@pytest.mark.parametrize("name", some(ENGINE.mutations, 8))
def test_each_deliberate_bug_shows(name: str) -> None:
    found = ENGINE.find(name, 1, 500)
    assert found is not None
    assert found.problems[0].startswith("ViolatedError"), found.problems
    assert not _violations(1, [found.number]), "without the bug the rules hold"


def test_a_schedule_is_always_the_same() -> None:
    with in_process(ENGINE.mutations["a zero waits for its turn"]):
        found = [_violations(1, range(10)) for _ in range(2)]
    assert found[0] == found[1]
    assert any(found[0])
