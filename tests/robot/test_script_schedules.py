"""A few of the random schedules of scripts and faults; ``python -m tests.robot.script_schedules`` runs hundreds."""

from __future__ import annotations

import pytest

from tests.robot.script_schedules.__main__ import perform
from tests.support import further

pytestmark = pytest.mark.alone  # deadlines are checked


@pytest.mark.parametrize(("transport", "seed"), [("mqtt", 4), further("zenoh", 2)])
def test_a_persons_stop_and_the_end_of_a_script_are_seen_at_the_wheels(transport: str, seed: int) -> None:
    ((_, found, log),) = perform(transport, [seed])
    assert not found, log
