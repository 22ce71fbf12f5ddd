"""Random schedules of persons, scripts and faults in virtual time: of one robot, of two motor owners, on a thin link.

``python -m tests.kit.schedules NAME`` runs thousands.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator

import pytest

from tests.kit.schedules import Engine
from tests.robot import thin_schedules
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
    ("name", "engine", "seed", "number", "least"),
    [
        ("lockstep", schedules.ENGINE, 0, cases(40, 150), {}),
        ("owners", two_owners.ENGINE, 1, cases(50, 150), {}),
        ("thin", thin_schedules.ENGINE, 0, cases(12, 1000), {"stops": 10, "confirmations": 10}),
    ],
    ids=("lockstep", "owners", "thin"),
)
def test_no_schedule_violates_a_rule(name: str, engine: Engine, seed: int, number: int, least: dict[str, int]) -> None:
    results = list(engine.run("", seed, range(number)))
    violated = [rule for result in results for rule in result.problems]
    assert not violated, f"python -m tests.kit.schedules {name} --seed {seed} prints the shortest schedule"
    counts = {count: sum(result.counts.get(count, 0) for result in results) for count in least}
    assert all(counts[count] > minimum for count, minimum in least.items()), counts
