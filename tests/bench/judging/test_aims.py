"""Aims that are bounds of a value; those of ratios are in test_bridge.py."""

from __future__ import annotations

import pytest

from pebble.bench.judging.aims import Aim, with_lost
from pebble.bench.results import Cell

SLOWEST = Aim(
    what="{variant}, p{load} at most {bound:g} ms", of=lambda cell: cell.variant == "zenoh", value=with_lost(99),
    at_most=2.0, unit="ms", never="not within 1 s", least=300, least_rounds=8,
)  # fmt: skip


def cell(ms: float, *, rounds: int = 8, each: int = 100, lost: int = 0, variant: str = "zenoh") -> Cell:
    figures = {"sent": each * rounds + lost}
    samples = [[ms] * each for _ in range(rounds)]
    return Cell(variant=variant, params={"load": "99"}, measure="down", unit="ms", rounds=samples, figures=figures)


@pytest.mark.parametrize(
    ("measured", "line"),
    [
        (cell(0.4), "met (0.40 ms)"),
        (cell(2.2), "missed (2.20 ms)"),
        (cell(0.4, lost=9), "missed (not within 1 s)"),
        (cell(0.4, each=0, lost=800), "missed (not within 1 s)"),
        (cell(0.4, rounds=7), "not judged (0.40 ms)"),
        (cell(0.4, each=36), "not judged (0.40 ms)"),
    ],
    ids=["met", "missed", "some lost", "all lost", "few rounds", "hardly anything beyond the percentile"],
)
def test_a_bound_is_judged(measured: Cell, line: str) -> None:
    assert [str(one) for one in SLOWEST([measured, cell(9.0, variant="mqtt")])] == [
        f"aim: zenoh, p99 at most 2 ms: {line}"
    ]
