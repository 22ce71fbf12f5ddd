"""A few of the random schedules with whole robots; ``python -m tests.kit.schedules robot_stops`` runs hundreds."""

from __future__ import annotations

import pytest

from tests.kit.schedules import Engine
from tests.robot.script_schedules.world import ENGINE as SCRIPTS
from tests.robot.stop_schedules.performance import ENGINE as STOPS
from tests.support import further

pytestmark = pytest.mark.alone  # deadlines are checked


@pytest.mark.parametrize(
    ("engine", "kind", "seed"),
    [
        (STOPS, "zenoh power cut", 2),
        further(STOPS, "mqtt killed before the state", 2),
        further(STOPS, "zenoh retained stop", 2),
        further(STOPS, "mqtt older save", 2),
        (SCRIPTS, "mqtt", 4),
        *(further(SCRIPTS, kind, 1) for kind in SCRIPTS.kinds),
    ],
)
def test_what_people_and_owners_do_is_seen_at_the_wheels(engine: Engine, kind: str, seed: int) -> None:
    (result,) = engine.run(kind, seed, range(1))
    assert not result.problems, result.log
