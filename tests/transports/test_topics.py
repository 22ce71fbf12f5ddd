"""Topics and filters, compared with paho's matcher (T1)."""

from __future__ import annotations

import random

import pytest
from paho.mqtt.client import topic_matches_sub

from pebble.errors import TransportError
from pebble.transports.topics import check_filter, check_topic, matches
from tests.support import cases

TRIED = cases(4_000, 20_000)
LEVELS = ["a", "b", "aa", "", "$", "$SYS", "é", "a b", "*"]


def random_filter(chosen: random.Random) -> str:
    levels = [chosen.choice([*LEVELS, "+", "+"]) for _ in range(chosen.randint(1, 5))]
    return "/".join([*levels, "#"] if chosen.random() < 0.3 else levels)


def random_topic(chosen: random.Random) -> str:
    return "/".join(chosen.choice(LEVELS) for _ in range(chosen.randint(1, 5)))


def test_matches_agrees_with_paho_on_random_pairs() -> None:
    chosen, hits = random.Random(20), 0
    for _ in range(TRIED):
        filter_, topic = random_filter(chosen), random_topic(chosen)
        wanted = topic_matches_sub(filter_, topic)
        assert matches(filter_, topic) is wanted, (filter_, topic)
        hits += wanted
    assert 0.025 < hits / TRIED < 0.975  # the pairs are neither all misses nor all hits


def test_errors_name_what_is_wrong() -> None:
    with pytest.raises(TransportError, match="wildcard"):
        check_topic("a/+/b")
    with pytest.raises(TransportError, match="last level"):
        check_filter("a/#/b")
    with pytest.raises(TransportError, match="1024"):
        check_topic("x" * 1025)
    with pytest.raises(TransportError, match="200 levels"):
        check_topic("/" * 200)
