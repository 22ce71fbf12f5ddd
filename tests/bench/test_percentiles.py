"""Percentiles, and rounding for JSON."""

import math

import pytest

from pebble.bench.results import percentile, rounded


@pytest.mark.parametrize(
    ("figures", "percent", "expected"),
    [
        ([5.0], 50, 5.0),
        ([3.0, 1.0, 2.0], 50, 2.0),
        ([1.0, 2.0], 50, 1.0),
        (list(range(1, 101)), 99, 99),
        (list(range(1, 101)), 100, 100),
        ([1.0, 9.0], 0, 1.0),
    ],
)
def test_a_percentile_is_a_figure_that_was_measured(figures: list[float], percent: float, expected: float) -> None:
    assert percentile(figures, percent) == expected


def test_nothing_has_no_percentile() -> None:
    assert math.isnan(percentile([], 50))


def test_json_gets_no_nan() -> None:
    assert rounded(math.nan, 1) is None
    assert rounded(None, 1) is None
    assert rounded(1.26, 1) == 1.3
    assert rounded(7, 1) == 7
