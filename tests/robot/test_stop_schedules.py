"""A few of the random schedules of stops and faults; ``python -m tests.kit.schedules robot_stops`` runs hundreds."""

from __future__ import annotations

import pytest

from tests.robot.stop_schedules.performance import ENGINE

pytestmark = pytest.mark.alone  # deadlines are checked


@pytest.mark.parametrize(
    "kind",
    [
        "zenoh power cut",
        "mqtt killed before the state",
        pytest.param("zenoh retained stop", marks=pytest.mark.thorough),
        pytest.param("mqtt older save", marks=pytest.mark.thorough),
    ],
)
def test_what_people_and_owners_do_is_seen_at_the_wheels(kind: str) -> None:
    (result,) = ENGINE.run(kind, 2, range(1))
    assert not result.problems, result.log
    assert result.counts["stops"]
