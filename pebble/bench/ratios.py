"""Is one thing faster than another, and by how much, given how much the machine's mood moves both? Pure.

Samples of one round are no independent witnesses: they share processes, a place in memory and a moment of the machine.
So a round counts as one witness, and chance is what resampling the rounds shows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np

from pebble.bench.figures import percentile

LEVEL = 0.99
#: Fewer rounds than this cannot carry an interval of 99 %: it is shown, and means little.
LEAST_ROUNDS = 8
_RESAMPLES = 20_000
_INFINITE = 1e15  # stands for infinity where ratios are resampled, which takes differences
_LARGEST = 1e6  # ratio that is written as a number
_SEED = 1  # the same samples give the same interval

_Floats = np.ndarray[Any, np.dtype[np.float64]]


@dataclass(frozen=True, slots=True)
class Interval:
    """A ratio, and where it lies with a certainty of ``level``; NaN where nothing was measured.

    With fewer than ``LEAST_ROUNDS`` nobody knows where it lies.
    """

    ratio: float
    low: float
    high: float
    level: float = LEVEL
    rounds: int = LEAST_ROUNDS

    def __str__(self) -> str:
        if math.isnan(self.ratio):
            return "–"
        if self.few:
            return _digits(self.ratio)
        return f"{_digits(self.ratio)} ({_digits(self.low)} to {_digits(self.high)})"

    @property
    def few(self) -> bool:
        """Are there too few rounds to tell?"""
        return self.rounds < LEAST_ROUNDS

    @property
    def equal(self) -> bool:
        """Cannot be told from 1."""
        return self.low <= 1.0 <= self.high

    def words(self, ours: str, theirs: str, *, what: str = "slower", less: str = "faster") -> str:
        """``zenoh is faster than mqtt: 0.55 (0.51 to 0.58) of its time``, or that they are equal within noise."""
        if math.isnan(self.ratio):
            return f"{ours} and {theirs}: nothing was measured"
        if self.few:
            return f"{ours} / {theirs} = {self}, of {self.rounds} rounds: too few to tell"
        if self.equal:
            return f"{ours} and {theirs} are equal within noise: {self}"
        return f"{ours} is {less if self.high < 1 else what} than {theirs}: {self} of its figure"


def paired(
    ours: Sequence[Sequence[float]],
    theirs: Sequence[Sequence[float]],
    percent: float = 50,
    level: float = LEVEL,
) -> Interval:
    """The median, over rounds run in turn, of the ratio of their percentiles.

    A sample may be infinite: what never arrived. Rounds without samples do not count, nor where both are infinite.
    """
    pairs = [(percentile(a, percent), percentile(b, percent)) for a, b in zip(ours, theirs, strict=False) if a and b]
    ratios = [min(a, _INFINITE) / min(b, _INFINITE) for a, b in pairs if b > 0 and min(a, b) < math.inf]
    if not ratios:
        return Interval(math.nan, math.nan, math.nan, level, 0)
    logs = np.log(ratios)
    picked = _generator().integers(0, len(logs), (_RESAMPLES, len(logs)))
    return _interval(float(np.median(logs)), np.median(logs[picked], axis=1), len(logs), level)


def unpaired(
    ours: Sequence[Sequence[float]],
    theirs: Sequence[Sequence[float]],
    percent: float = 50,
    level: float = LEVEL,
) -> Interval:
    """The same for two runs at different times: the ratio of the medians of their rounds' percentiles."""
    a, b = (
        np.log([value for one in rounds if one and (value := percentile(one, percent)) > 0])
        for rounds in (ours, theirs)
    )
    if not len(a) or not len(b):
        return Interval(math.nan, math.nan, math.nan, level, 0)
    generator = _generator()
    resampled = [np.median(logs[generator.integers(0, len(logs), (_RESAMPLES, len(logs)))], axis=1) for logs in (a, b)]
    return _interval(float(np.median(a) - np.median(b)), resampled[0] - resampled[1], min(len(a), len(b)), level)


def _interval(ratio: float, resampled: _Floats, rounds: int, level: float) -> Interval:
    if rounds < 2:
        return Interval(math.exp(ratio), 0.0, math.inf, level, rounds)
    tail = (1 - level) / 2
    wider = student(level, rounds) / NormalDist().inv_cdf(1 - tail)
    low, high = (ratio + wider * (end - ratio) for end in np.quantile(resampled, [tail, 1 - tail]))
    return Interval(math.exp(ratio), math.exp(low), math.exp(high), level, rounds)


def student(level: float, rounds: int) -> float:
    """Half of an interval's width in standard errors: few rounds tell little of their own spread; at least two."""
    z, freedom = NormalDist().inv_cdf((1 + level) / 2), rounds - 1
    return z * (1 + (z**2 + 1) / (4 * freedom) + (5 * z**4 + 16 * z**2 + 3) / (96 * freedom**2))


def _digits(ratio: float) -> str:
    if ratio >= _LARGEST:
        return "∞"
    return f"{ratio:.2f}" if ratio >= 0.1 else f"{ratio:.2g}" if ratio > 1 / _LARGEST else "0"


def _generator() -> np.random.Generator:
    return np.random.default_rng(_SEED)
