"""The offset of two clocks from messages there and back: within its error, or unknown."""

import math
import random

import pytest

from pebble.bench.control.ends import Exchange
from pebble.bench.control.far import DRIFT, LEAST, estimate

SECOND = 10**9
SEEDS = range(300)


def exchanges(
    random_: random.Random, *, count: int = 200, offset: int = 0, drift: float = 0.0, there_us: float, back_us: float
) -> list[Exchange]:
    """At least half a millisecond each way, and queues that are longer in one direction."""

    def far(now: int) -> int:
        return now + offset + round(drift * now)

    found, now = [], 0
    for _ in range(count):
        received = now + 500_000 + round(1000 * random_.expovariate(1 / there_us))
        sent = received + random_.randrange(5_000, 200_000)
        back = sent + 500_000 + round(1000 * random_.expovariate(1 / back_us))
        found.append(Exchange(now, far(received), far(sent), back))
        now += SECOND // 100
    return found


@pytest.mark.parametrize("drift", [0.0, DRIFT, -DRIFT])
def test_the_true_offset_lies_within_the_error_all_the_time(drift: float) -> None:
    inside = 0
    for seed in SEEDS:
        random_ = random.Random(seed)
        offset = random_.randrange(-5 * SECOND, 5 * SECOND)
        measured = exchanges(random_, offset=offset, drift=drift, there_us=2000, back_us=50)
        found = estimate(measured)
        truths = [offset + drift * now for now in (measured[0].t1, measured[100].t1, measured[-1].t4)]
        inside += all(abs(found.ns - truth) <= found.error_ns for truth in truths)
    assert inside == len(SEEDS)


def test_the_error_is_no_more_than_half_of_the_shortest_round_trip_and_the_drift() -> None:
    measured = exchanges(random.Random(1), there_us=300, back_us=300)
    shortest = min(one.t4 - one.t1 - (one.t3 - one.t2) for one in measured)
    found = estimate(measured)
    assert found.error_ns <= shortest / 2 + DRIFT * (measured[-1].t4 - measured[0].t1) + 1


def test_the_offset_of_too_few_exchanges_is_unknown() -> None:
    measured = exchanges(random.Random(3), count=LEAST - 1, there_us=1, back_us=1)
    assert estimate(measured).error_ns == math.inf


def test_the_offset_of_a_clock_that_was_set_meanwhile_is_unknown() -> None:
    before = exchanges(random.Random(4), there_us=1, back_us=1)
    after = [one._replace(t2=one.t2 + SECOND, t3=one.t3 + SECOND) for one in before[100:]]
    assert estimate(before[:100] + after).error_ns == math.inf
