"""A few random schedules of scripts and faults; ``python -m tests.kit.schedules robot_scripts`` runs hundreds."""

from __future__ import annotations

import pytest

from tests.robot.script_schedules.world import ENGINE
from tests.support import further

pytestmark = pytest.mark.alone  # deadlines are checked


@pytest.mark.parametrize(("transport", "seed"), [("mqtt", 4), further("zenoh", 2)])
def test_a_persons_stop_and_the_end_of_a_script_are_seen_at_the_wheels(transport: str, seed: int) -> None:
    (result,) = ENGINE.run(transport, seed, range(1))
    assert not result.problems, result.log
