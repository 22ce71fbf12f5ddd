"""A robot runs for a minute in the real MicroPython within its board's memory. ``make test THOROUGH=1``: each does."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.firmware.heap import CASES, LIMITS, Case, measure
from tests.firmware.sizes import documented
from tests.support import some

pytestmark = pytest.mark.computing

_PEAK = 7  # column of the table


@pytest.mark.parametrize("case", some(CASES, len(CASES)), ids=str)
def test_heap(case: Case, tmp_path: Path) -> None:
    cost = measure(case, tmp_path)
    limit = LIMITS[case]
    assert limit is None or cost.peak <= limit, f"{case}: {cost}"
    documented_peak = int(documented()[str(case)][_PEAK])
    assert abs(documented_peak - cost.peak) <= 0.02 * cost.peak, (
        f"docs has {documented_peak}, measured {cost.peak}: make long PART=firmware"
    )
    assert cost.imported < cost.built <= cost.live <= cost.peak, cost  # else something was not measured
