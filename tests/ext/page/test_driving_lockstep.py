"""Random schedules of humans, pages, networks and servers in virtual time.

``python -m tests.kit.schedules driving_lockstep`` runs thousands.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterable, Iterator

import pytest

from tests.ext.page.driving_lockstep.schedules import ENGINE
from tests.kit.schedules import Result
from tests.support import cases

pytestmark = pytest.mark.computing

SCHEDULES = cases(16, 300)
PARTS = 4  # of them, for as many processes of pytest


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    if shutil.which("node") is None:
        pytest.skip("node is not installed")
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


def _results(seed: int, numbers: Iterable[int]) -> list[Result]:
    return list(ENGINE.run("", seed, numbers))


@pytest.mark.parametrize("part", range(PARTS))
def test_no_schedule_violates_a_rule(part: int) -> None:
    found = _results(0, range(part, SCHEDULES, PARTS))
    assert not any(one.problems for one in found), "python -m tests.kit.schedules driving_lockstep --seed 0 shows it"
    assert sum(one.counts["drives"] for one in found) > SCHEDULES / PARTS
