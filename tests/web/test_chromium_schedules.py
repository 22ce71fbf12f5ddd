"""A few of the random sequences in Chromium; ``python -m tests.web.chromium_schedules`` runs hundreds."""

from __future__ import annotations

import pytest

from tests.web.chromium_schedules.__main__ import perform

pytestmark = pytest.mark.page  # deadlines are checked


@pytest.mark.parametrize(("robot", "seed"), [("minilamp", 26), ("minilamp", 28), ("fred", 9)])
def test_no_wheel_turns_outside_a_living_gesture(robot: str, seed: int) -> None:
    ((_, found, log),) = perform(robot, [seed])
    assert not found, (found, log)
