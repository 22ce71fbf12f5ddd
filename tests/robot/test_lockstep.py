"""Random schedules of persons, scripts and faults in virtual time: of one robot, and of two motor owners.

``python -m tests.kit.schedules NAME`` runs thousands.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator

import pytest

from tests.kit.schedules import Engine
from tests.robot.lockstep import schedules, two_owners
from tests.support import cases

pytestmark = pytest.mark.computing


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    """What services log would take most of the time."""
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.parametrize(
    ("name", "engine", "seed", "number"),
    [
        ("lockstep", schedules.ENGINE, 0, cases(40, 150)),
        ("owners", two_owners.ENGINE, 1, cases(50, 150)),
    ],
    ids=("lockstep", "owners"),
)
def test_no_schedule_violates_a_rule(name: str, engine: Engine, seed: int, number: int) -> None:
    violated = [rule for result in engine.run("", seed, range(number)) for rule in result.problems]
    assert not violated, f"python -m tests.kit.schedules {name} --seed {seed} prints the shortest schedule"
