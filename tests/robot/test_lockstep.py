"""Random schedules of persons, scripts and faults in virtual time.

``python -m tests.kit.schedules lockstep`` runs thousands.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator

import pytest

from tests.robot.lockstep.schedules import ENGINE
from tests.support import cases

pytestmark = pytest.mark.computing

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
