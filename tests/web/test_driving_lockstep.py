"""Random schedules of humans, pages, networks and servers in virtual time; deliberate bugs show in them.

``python -m tests.web.driving_lockstep`` runs thousands.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator

import pytest

from tests.support import cases
from tests.web.driving_lockstep.mutations import MUTATIONS
from tests.web.driving_lockstep.schedules import first_violation, generate, violation
from tests.web.driving_lockstep.world import Rig

SCHEDULES = cases(40, 300)
PARTS = 4  # of them, for as many processes of pytest
#: Bugs that show within 20 schedules; ``python -m tests.web.driving_lockstep --mutations`` looks for all.
QUICK = (
    "the number of a gesture is not checked",
    "a silent gesture goes on",
    "zeros are not forwarded",
    "commands are valid for long",
    "an interruption leaves the inputs as they are",
    "the end of a gesture is not sent",
)


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    if shutil.which("node") is None:
        pytest.skip("node is not installed")
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.parametrize("part", range(PARTS))
def test_no_schedule_violates_a_rule(part: int) -> None:
    with Rig() as rig:
        found = [violation(generate(0, number), rig) for number in range(part, SCHEDULES, PARTS)]
    assert not any(found), "python -m tests.web.driving_lockstep --seed 0 prints the shortest schedule"
    assert rig.drives > SCHEDULES / PARTS


@pytest.mark.parametrize("name", QUICK)
def test_each_deliberate_bug_shows(name: str) -> None:
    mutation = MUTATIONS[name]
    with mutation.applied() as folder, Rig(folder) as rig:
        found = first_violation(1, 100, rig, mutation.schedule)
    assert found is not None
    assert found[1].startswith("ViolatedError"), found[1]


@pytest.mark.thorough
def test_a_schedule_is_always_the_same() -> None:
    with MUTATIONS["the number of a gesture is not checked"].applied() as folder:
        found = []
        for _ in range(2):
            with Rig(folder) as rig:
                found.append([violation(generate(1, number), rig) for number in range(8, 16)])
    assert found[0] == found[1]
    assert any(found[0])
