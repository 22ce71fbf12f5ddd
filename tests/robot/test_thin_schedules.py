"""A thin link, a take-over and a stop at once: the stop first, always.

``python -m tests.kit.schedules thin`` runs more.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator

import pytest

from tests.robot.thin_schedules import ENGINE
from tests.support import cases

pytestmark = pytest.mark.computing


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    """What services log would take most of the time."""
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


def test_no_schedule_violates_a_rule() -> None:
    results = list(ENGINE.run("", 0, range(cases(12, 1000))))
    assert [rule for one in results for rule in one.problems] == []
    counts = {name: sum(one.counts.get(name, 0) for one in results) for name in ("stops", "confirmations")}
    assert min(counts.values()) > 10, counts
