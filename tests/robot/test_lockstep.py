"""Random schedules of drivers, scripts, stops and faults of two motor owners in virtual time.

``python -m tests.kit.schedules services`` runs thousands.
"""

from __future__ import annotations

import pytest

from tests.robot.lockstep.schedules import ENGINE
from tests.support import cases

pytestmark = [pytest.mark.computing, pytest.mark.usefixtures("quiet")]


@pytest.mark.parametrize(
    ("kind", "seed", "number"),
    [("owners", 1, cases(60, 200)), ("groups", 2, cases(20, 150))],
)
def test_no_schedule_violates_a_rule(kind: str, seed: int, number: int) -> None:
    violated = [rule for result in ENGINE.run(kind, seed, range(number)) for rule in result.problems]
    assert not violated, (
        f"python -m tests.kit.schedules services --kind {kind} --seed {seed} prints the shortest schedule"
    )
