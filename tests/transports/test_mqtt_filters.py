"""Filters a broker is told never overlap, and catch everything that is wanted."""

from __future__ import annotations

import itertools
import random

from pebble.transports.mqtt_filters import BrokerFilters, cover, overlap
from pebble.transports.topics import matches

LEVELS = ["a", "b", "$x", "+"]
TOPICS = [
    "/".join(levels) for depth in (1, 2, 3, 4) for levels in itertools.product(["a", "b", "c", "$x"], repeat=depth)
]  # with one level more than any filter has, and one word more
FILTERS = [
    "/".join([*levels, *end])
    for depth in (0, 1, 2, 3)
    for levels in itertools.product(LEVELS, repeat=depth)
    for end in ([], ["#"])
    if levels or end
]


def caught(filter_: str) -> frozenset[str]:
    return frozenset(topic for topic in TOPICS if matches(filter_, topic))


CAUGHT = {filter_: caught(filter_) for filter_ in FILTERS}


def test_overlap_means_that_a_topic_matches_both() -> None:
    for one, other in itertools.combinations_with_replacement(FILTERS, 2):
        wanted = bool(CAUGHT[one] & CAUGHT[other])
        assert overlap(one, other) is overlap(other, one) is wanted, (one, other)


def test_a_cover_catches_what_both_catch() -> None:
    for one, other in itertools.combinations(FILTERS, 2):
        if overlap(one, other):
            assert CAUGHT[one] | CAUGHT[other] <= caught(cover(one, other)), (one, other)


def test_filters_told_never_overlap_and_miss_nothing() -> None:
    chosen = random.Random(3)
    for _ in range(300):
        told, wanted = BrokerFilters(), []
        for filter_ in chosen.sample(FILTERS, 6):
            wanted.append(filter_)
            subscribe, replaced = told.add(filter_)
            assert subscribe in told
            assert not set(replaced) & set(told)
            check(told, wanted)
        while wanted:
            wanted.remove(chosen.choice(wanted))
            told.prune(wanted)
            check(told, wanted)
        assert list(told) == []


def check(told: BrokerFilters, wanted: list[str]) -> None:
    assert not any(overlap(one, other) for one, other in itertools.combinations(told, 2))
    needed = frozenset().union(*(CAUGHT[filter_] for filter_ in wanted))
    assert needed <= frozenset().union(*(caught(filter_) for filter_ in told))


def test_the_same_filter_again_is_asked_for_again() -> None:
    told = BrokerFilters()
    assert told.add("a/#") == ("a/#", [])
    assert told.add("a/b") == ("a/#", [])
    assert told.add("+/b") == ("+/#", ["a/#"])
