"""Pictures draw what was measured, and what was lost."""

from __future__ import annotations

import pytest

from pebble.extensions.lab.bench import plots
from pebble.extensions.lab.bench.results import Cell


def test_nothing_measured_is_no_picture() -> None:
    nothing = [Cell(variant="mqtt", measure="way", unit="us", params={"n": 1}, rounds=rounds) for rounds in ([], [[]])]
    assert (plots.curves("x", "X", nothing), plots.lines("x", "X", nothing, over="n")) == ([], [])


def test_a_distribution_ends_below_100_percent_by_what_was_lost() -> None:
    for sent, top in ((90, 100), (100, 90)):
        cell = Cell(variant="mqtt", measure="way", unit="ms", rounds=[[1.0] * 90], figures={"sent": [sent]})
        (picture,) = plots.curves("x", "X", [cell])
        (curve, *_) = picture.make().axes[0].get_lines()
        assert max(curve.get_ydata()) == pytest.approx(top)  # type: ignore[arg-type]
