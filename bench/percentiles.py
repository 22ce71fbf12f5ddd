"""Percentiles and rounding, the same for all comparisons. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence

LONGEST_S = 3600.0  # of one phase of a comparison


def percentile(figures: Sequence[float], percent: float) -> float:
    """The smallest value that at least ``percent`` per cent of the values do not exceed; NaN without values."""
    if not figures:
        return math.nan
    ordered = sorted(figures)
    return ordered[max(0, math.ceil(len(ordered) * percent / 100) - 1)]


def rounded(figure: float | int | None, digits: int) -> float | int | None:
    """Rounds for JSON, which has no NaN: None means not measured."""
    if figure is None or not math.isfinite(figure):
        return None
    return figure if isinstance(figure, int) else round(figure, digits)
