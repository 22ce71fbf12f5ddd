"""A few of the random schedules with whole robots; ``python -m tests.kit.schedules robot`` runs hundreds."""

from __future__ import annotations

import pytest

from tests.robot.whole import ENGINE
from tests.support import further

pytestmark = pytest.mark.alone  # deadlines are checked


@pytest.mark.parametrize(("kind", "seed"), [("zenoh", 2), *(further(kind, 1) for kind in ENGINE.kinds)])
def test_what_people_and_owners_do_is_seen_at_the_wheels(kind: str, seed: int) -> None:
    (result,) = ENGINE.run(kind, seed, range(1))
    assert not result.problems, f"{result.problems}\n{result.log}"
