"""Percentiles as all comparisons mean them. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence

LONGEST_S = 3600.0  # of one phase of a comparison


def percentile(figures: Sequence[float], percent: float) -> float:
    """The smallest figure that at least ``percent`` per cent do not exceed; NaN of nothing."""
    if not figures:
        return math.nan
    ordered = sorted(figures)
    return ordered[max(0, math.ceil(len(ordered) * percent / 100) - 1)]


def rounded(figure: float | int | None, digits: int) -> float | int | None:
    """For JSON, which knows no NaN: None, nothing was measured."""
    if figure is None or not math.isfinite(figure):
        return None
    return figure if isinstance(figure, int) else round(figure, digits)
