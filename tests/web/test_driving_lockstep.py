"""Random schedules of humans, pages, networks and servers in virtual time; deliberate bugs show in them.

``python -m tests.kit.schedules driving_lockstep`` runs thousands.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

from tests.kit.schedules import Result
from tests.support import cases, some
from tests.web.driving_lockstep.mutations import mutated
from tests.web.driving_lockstep.schedules import ENGINE

SCHEDULES = cases(16, 300)
PARTS = 4  # of them, for as many processes of pytest
#: Bugs that show within 20 schedules; ``python -m tests.kit.schedules driving_lockstep --mutations`` looks for all.
QUICK = (
    "the number of a gesture is not checked",
    "a silent gesture goes on",
    "zeros are not forwarded",
    "commands are valid for long",
    "an interruption leaves the inputs as they are",
    "the end of a gesture is not sent",
    "a gamepad needs no neutral",
)


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    if shutil.which("node") is None:
        pytest.skip("node is not installed")
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


def _results(seed: int, numbers: Iterable[int], bug: Path | None = None) -> list[Result]:
    return list(ENGINE.run("", seed, numbers, bug))


@pytest.mark.parametrize("part", range(PARTS))
def test_no_schedule_violates_a_rule(part: int) -> None:
    found = _results(0, range(part, SCHEDULES, PARTS))
    assert not any(one.problems for one in found), "python -m tests.kit.schedules driving_lockstep --seed 0 shows it"
    assert sum(one.counts["drives"] for one in found) > SCHEDULES / PARTS


@pytest.mark.parametrize("name", some(QUICK, 2))
def test_each_deliberate_bug_shows(name: str) -> None:
    found = ENGINE.find(name, 1, 100)
    assert found is not None
    assert found.problems[0].startswith("ViolatedError"), found.problems


@pytest.mark.thorough
def test_a_schedule_is_always_the_same() -> None:
    with mutated(ENGINE.mutations["the number of a gesture is not checked"]) as folder:
        found = [[one.problems for one in _results(1, range(8, 16), folder)] for _ in range(2)]
    assert found[0] == found[1]
    assert any(found[0])
