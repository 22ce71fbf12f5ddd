"""Intervals of ratios: correct as often as their level, and narrow enough to detect a fifth."""

import math

import numpy as np
import pytest

from pebble.bench.judging import ratios
from pebble.bench.judging.ratios import LEAST_ROUNDS, Interval, paired, unpaired

Rounds = list[list[float]]
RUNS = 300


@pytest.fixture(autouse=True)
def fewer_resamples(monkeypatch: pytest.MonkeyPatch) -> None:
    """A number of resamplings for hundreds of intervals within a second or two."""
    monkeypatch.setattr(ratios, "RESAMPLES", 1000)


def make(random: np.random.Generator, rounds: int, *, factor: float = 1.0, mood: float = 0.05) -> Rounds:
    """The samples look as measured ones do: each round has an offset of its own, and a long tail."""
    moods = factor * np.exp(random.normal(0, mood, rounds))
    return [(100 * one * np.exp(random.normal(0, 0.1, 25))).tolist() for one in moods]


@pytest.mark.parametrize("rounds", [LEAST_ROUNDS, 12])
@pytest.mark.parametrize("judge", [paired, unpaired])
def test_the_same_twice_is_called_equal(judge: type[paired], rounds: int) -> None:
    random = np.random.default_rng(rounds)
    equal = sum(judge(make(random, rounds), make(random, rounds)).equal for _ in range(RUNS))
    assert equal >= 0.975 * RUNS  # the level is 99 %; 300 runs cannot distinguish it from 98 %


@pytest.mark.parametrize("judge", [paired, unpaired])
def test_a_fifth_more_is_detected(judge: type[paired]) -> None:
    random = np.random.default_rng(7)
    seen = sum(judge(make(random, 12, factor=1.2, mood=0.04), make(random, 12, mood=0.04)).low > 1 for _ in range(100))
    assert seen >= 95


def test_variation_that_both_share_cancels_out_in_turns() -> None:
    random = np.random.default_rng(3)
    theirs = make(random, 10, mood=0.5)
    ours = [[1.2 * sample for sample in one] for one in theirs]
    assert paired(ours, theirs).low == pytest.approx(1.2)
    assert unpaired(ours, theirs).equal


def test_few_rounds_give_wider_intervals() -> None:
    ours, theirs = [[90.0], [110.0]], [[100.0], [100.0]]
    few, more = paired(ours, theirs), paired(4 * ours, 4 * theirs)
    assert few.low < more.low < 1 < more.high < few.high


def test_a_higher_certainty_takes_a_wider_interval() -> None:
    random = np.random.default_rng(4)
    ours, theirs = make(random, 10), make(random, 10)
    usual, surer = unpaired(ours, theirs), unpaired(ours, theirs, level=0.9999)
    assert surer.low < usual.low < usual.high < surer.high
    assert surer.level == 0.9999


def test_the_percentile_is_that_of_each_round() -> None:
    rounds = [[1.0] * 98 + [50.0, 50.0]] * 3
    assert paired(rounds, [[1.0]] * 3, 99).ratio == pytest.approx(50)
    assert paired(rounds, [[1.0]] * 3, 50).ratio == pytest.approx(1)


def test_failed_rounds_do_not_count() -> None:
    ours, theirs = [[2.0], [], [2.0], [9.0]], [[1.0], [1.0], [], [0.0]]
    assert paired(ours, theirs).ratio == pytest.approx(2)
    assert unpaired([[2.0], []], [[], [1.0]]).ratio == pytest.approx(2)


def test_what_never_arrived_is_infinitely_late() -> None:
    mostly, never = [[1.0, 1.0, math.inf]] * 10, [[1.0, math.inf, math.inf]] * 10
    assert paired(mostly, [[2.0]] * 10).ratio == pytest.approx(0.5)
    assert str(paired(never, [[2.0]] * 10)) == "∞ (∞ to ∞)"
    assert str(paired([[2.0]] * 10, never)) == "0 (0 to 0)"
    assert math.isnan(paired(never, never).ratio)
    assert paired([*never[:1], *mostly[:9]], [*never[:2], *mostly[:8]]).rounds == 9


@pytest.mark.parametrize("judge", [paired, unpaired])
@pytest.mark.parametrize(("ours", "theirs"), [([], []), ([[]], [[1.0]]), ([[1.0]], [[]]), ([[1.0]], [[0.0]])])
def test_nothing_measured_is_nothing_claimed(judge: type[paired], ours: Rounds, theirs: Rounds) -> None:
    interval = judge(ours, theirs)
    assert math.isnan(interval.ratio)
    assert not interval.equal
    assert (str(interval), interval.words("a", "b")) == ("–", "a and b: nothing was measured")


def test_the_same_samples_give_the_same_interval() -> None:
    rounds = make(np.random.default_rng(1), 8), make(np.random.default_rng(2), 8)
    assert paired(*rounds) == paired(*rounds)


@pytest.mark.parametrize(
    ("interval", "words"),
    [
        (Interval(0.5, 0.4, 0.6), "a takes 0.50× the time of b (99 % interval 0.40–0.60)"),
        (Interval(2.0, 1.5, 2.5), "a takes 2.00× the time of b (99 % interval 1.50–2.50)"),
        (Interval(1.1, 0.9, 1.3), "a and b are equal within noise: 1.10× the time (99 % interval 0.90–1.30)"),
    ],
)
def test_words(interval: Interval, words: str) -> None:
    assert interval.words("a", "b") == words
