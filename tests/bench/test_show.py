"""Pictures draw what was measured, and what was lost."""

from __future__ import annotations

import pytest

from pebble.bench import plots
from pebble.bench.results import Cell


def test_nothing_measured_is_no_picture() -> None:
    nothing = [Cell(variant="mqtt", measure="way", unit="us", params={"n": 1}, rounds=rounds) for rounds in ([], [[]])]
    drawn = (plots.curves("x", "X", nothing), plots.ratios("x", "X", nothing, "mqtt"),
             plots.lines("x", "X", nothing, over="n"),
             plots.medians("x", "X", nothing, panel=Cell.conditions, row=Cell.conditions))  # fmt: skip
    assert drawn == ([], [], [], [])


def test_a_distribution_ends_below_100_percent_by_what_was_lost() -> None:
    for sent, top in ((90, 100), (100, 90)):
        cell = Cell(variant="mqtt", measure="way", unit="ms", rounds=[[1.0] * 90], figures={"sent": [sent]})
        (picture,) = plots.curves("x", "X", [cell])
        (curve, *_) = picture.make().axes[0].get_lines()
        assert max(curve.get_ydata()) == pytest.approx(top)  # type: ignore[arg-type]


@pytest.mark.parametrize(("rounds", "has_interval"), [(7, False), (8, True)])
def test_few_rounds_have_no_interval(rounds: int, has_interval: bool) -> None:
    samples = [[1.0, 1.1 + number / 10] for number in range(rounds)]
    cells = [Cell(variant=name, measure="up", unit="ms", rounds=samples) for name in ("mqtt", "zenoh")]
    (picture,) = plots.ratios("x", "X", cells, "mqtt")
    (interval, *_) = picture.make().axes[0].get_lines()
    assert len(interval.get_xdata()) == 1 + has_interval  # type: ignore[arg-type]
