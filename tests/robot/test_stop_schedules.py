"""A few of the random schedules of stops and faults; ``python -m tests.robot.stop_schedules`` runs hundreds."""

from __future__ import annotations

import pytest

from tests.robot.stop_schedules.__main__ import perform

pytestmark = pytest.mark.alone  # deadlines are checked


@pytest.mark.parametrize(
    ("transport", "setup"),
    [
        ("zenoh", "power cut"),
        ("mqtt", "killed before the state"),
        pytest.param("zenoh", "retained stop", marks=pytest.mark.thorough),
        pytest.param("mqtt", "older save", marks=pytest.mark.thorough),
    ],
)
def test_what_people_and_owners_do_is_seen_at_the_wheels(transport: str, setup: str) -> None:
    (result,) = perform(transport, setup, [2])
    assert not result.problems
    assert result.stops
