"""The ratio of two variants' latencies, and its confidence interval over rounds. Pure.

Samples of one round are not independent: they share processes, a memory layout and a moment of the machine. So each
round counts as one observation, and the variation is estimated by resampling the rounds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

from pebble.bench.results import percentile

LEVEL = 0.99
LEAST_ROUNDS = 8  # fewer do not support a 99 % interval: it is computed, but means little
RESAMPLES = 20_000
_INFINITE = 1e15  # stands for infinity where resampling computes differences
_LARGEST = 1e6  # ratio that is written as a number

Rounds = Sequence[Sequence[float]]  # the samples of each


@dataclass(frozen=True, slots=True)
class Interval:
    """A ratio and its confidence interval at ``level``, which few rounds do not support; NaN: nothing was measured."""

    ratio: float = math.nan
    low: float = math.nan
    high: float = math.nan
    level: float = LEVEL
    rounds: int = LEAST_ROUNDS

    def __str__(self) -> str:
        interval = "" if self.few else f" ({_digits(self.low)} to {_digits(self.high)})"
        return f"{_digits(self.ratio)}{interval}" if self.known else "–"

    @property
    def known(self) -> bool:
        return not math.isnan(self.ratio)

    @property
    def few(self) -> bool:
        return self.rounds < LEAST_ROUNDS

    @property
    def equal(self) -> bool:
        return self.low <= 1.0 <= self.high

    def words(self, ours: str, theirs: str, quantity: str = "time") -> str:
        """``zenoh takes 0.55× the time of mqtt (99 % interval 0.51–0.58)``, or that both are equal within noise."""
        if not self.known:
            return f"{ours} and {theirs}: nothing was measured"
        if self.few:
            return f"{ours} / {theirs} = {self}, from {self.rounds} rounds: too few to judge"
        interval = f"{100 * self.level:.4g} % interval {_digits(self.low)}–{_digits(self.high)}"
        if self.equal:
            return f"{ours} and {theirs} are equal within noise: {_digits(self.ratio)}× the {quantity} ({interval})"
        return f"{ours} takes {_digits(self.ratio)}× the {quantity} of {theirs} ({interval})"


def paired(ours: Rounds, theirs: Rounds, percent: float = 50) -> Interval:
    """The median, over rounds run in turn, of the ratio of their percentiles; where both are infinite, none."""
    pairs = [(percentile(a, percent), percentile(b, percent)) for a, b in zip(ours, theirs, strict=False) if a and b]
    ratios = [min(a, _INFINITE) / min(b, _INFINITE) for a, b in pairs if b > 0 and min(a, b) < math.inf]
    logs = [math.log(ratio) if ratio else -math.inf for ratio in ratios]
    return _interval(logs, [0.0] * len(logs), LEVEL)


def unpaired(ours: Rounds, theirs: Rounds, percent: float = 50, level: float = LEVEL) -> Interval:
    """The same for two runs at different times: the ratio of the medians of their rounds' percentiles."""
    figures = ([percentile(one, percent) for one in rounds if one] for rounds in (ours, theirs))
    a, b = ([math.log(one) for one in some if one > 0] for some in figures)
    return _interval(a, b, level)


def _interval(ours: Sequence[float], theirs: Sequence[float], level: float) -> Interval:
    """The difference of the medians of logarithms, from many samples of as many rounds, drawn with replacement."""
    rounds = min(len(ours), len(theirs))
    if not rounds:
        return Interval(level=level, rounds=0)
    import numpy as np  # importing it earlier than it is needed would change the memory of measured processes

    ratio = float(np.median(ours) - np.median(theirs))
    random = np.random.default_rng(1)  # the same samples give the same interval
    a, b = (np.median(random.choice(logs, (RESAMPLES, len(logs))), axis=1) for logs in (ours, theirs))
    tail, wider = (1 - level) / 2, student(level, rounds) / student(level, math.inf)
    low, high = (ratio + wider * (end - ratio) for end in np.quantile(a - b, [tail, 1 - tail]))
    return Interval(math.exp(ratio), math.exp(low), math.exp(high), level, rounds)


def student(level: float, rounds: float) -> float:
    """Half of an interval's width in standard errors: Student's t, approximated."""
    z, freedom = NormalDist().inv_cdf((1 + level) / 2), max(1, rounds - 1)
    return z * (1 + (z**2 + 1) / (4 * freedom) + (5 * z**4 + 16 * z**2 + 3) / (96 * freedom**2))


def _digits(ratio: float) -> str:
    if ratio >= _LARGEST:
        return "∞"
    return f"{ratio:.2f}" if ratio >= 0.1 else f"{ratio:.2g}" if ratio > 1 / _LARGEST else "0"
