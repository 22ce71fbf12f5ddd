"""Filters: which topics they match, which overlap, and their Zenoh keys; own and repeated messages are recognised."""

from __future__ import annotations

import itertools
import random
import tracemalloc

import pytest
import zenoh
from paho.mqtt.client import topic_matches_sub

from pebble.transports import Message
from pebble.transports.mqtt import filters
from pebble.transports.mqtt.filters import BrokerFilters, OwnMessageFilter, overlap
from pebble.transports.topics import matches
from pebble.transports.zenoh.keymap import filter_to_key, key_to_topic, topic_to_key
from tests.support import THOROUGH, cases, some

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
    for one, other in some(itertools.combinations_with_replacement(FILTERS, 2), 3):
        wanted = bool(CAUGHT[one] & CAUGHT[other])
        assert overlap(one, other) is overlap(other, one) is wanted, (one, other)


def test_subscribed_filters_never_overlap_and_miss_nothing() -> None:
    chosen = random.Random(3)
    for _ in range(3000 if THOROUGH else 25):
        filters, wanted = BrokerFilters(), []
        for filter_ in chosen.sample(FILTERS, 6):
            wanted.append(filter_)
            subscribe, replaced = filters.add(filter_)
            assert subscribe in filters
            assert not set(replaced) & set(filters)
            check(filters, wanted)
        while wanted:
            unwanted = wanted.pop(chosen.randrange(len(wanted)))
            filters.prune(unwanted, wanted)
            check(filters, wanted)
        assert list(filters) == []


def check(filters: BrokerFilters, wanted: list[str]) -> None:
    assert not any(overlap(one, other) for one, other in itertools.combinations(filters, 2))
    needed = frozenset().union(*(CAUGHT[filter_] for filter_ in wanted))
    assert needed <= frozenset().union(*(caught(filter_) for filter_ in filters))


def retained(payload: bytes, topic: str = "flag") -> Message:
    return Message(topic, payload, retain=True)


def test_a_copy_is_a_repeat_only_when_one_is_due() -> None:
    own_filter = OwnMessageFilter()
    assert not own_filter.is_repeat(retained(b"1"))
    assert not own_filter.is_repeat(retained(b"1"))  # published again by another client: a new message
    own_filter.subscribe_again("#")
    assert own_filter.is_repeat(retained(b"1"))
    assert not own_filter.is_repeat(retained(b"1"))


def test_a_new_value_that_overtakes_a_due_repeat_is_delivered() -> None:
    own_filter = OwnMessageFilter()
    own_filter.is_repeat(retained(b"1"))
    own_filter.is_repeat(retained(b"1", "elsewhere"))
    own_filter.subscribe_again("flag")
    assert not own_filter.is_repeat(retained(b"2"))
    assert own_filter.is_repeat(retained(b"2"))
    assert not own_filter.is_repeat(retained(b"1", "elsewhere"))


def test_large_payloads_and_many_topics_take_little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(filters, "_LIMIT", 100)
    own_filter = OwnMessageFilter()
    tracemalloc.start()
    for number in range(200):
        message = retained(bytes(100_000), f"flag{number}")
        own_filter.note_own(message)
        own_filter.is_repeat(message)
    used, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert used < 500_000
    assert own_filter.is_echo(retained(bytes(100_000), "flag199"))
    assert not own_filter.is_echo(retained(bytes(100_000), "flag0"))


ODD_LEVELS = ["", "a", "b", "ab", "@", "@a", "$", "$a", "%", "%40", "*", "**", "a*", "?"]
ODD_LEVELS += ["%25", "ä", "a b", "@retain", "$*"]


def random_filter(dice: random.Random) -> str:
    levels = dice.choices([*ODD_LEVELS, "+", "+", "a", "a"], k=dice.randint(1, 4))
    return "/".join([*levels, *dice.choice(([], [], ["#"]))]) or "#"


def random_topic(dice: random.Random) -> str:
    return "/".join(dice.choices([*ODD_LEVELS, "a", "a", "a"], k=dice.randint(1, 5))) or "a"


def test_filters_and_keys_match_where_paho_matches_topics() -> None:
    dice = random.Random(1)
    matched = 0
    for _ in range(cases(4_000, 20_000)):
        filter_, topic = random_filter(dice), random_topic(dice)
        wanted = topic_matches_sub(filter_, topic)
        matched += wanted
        assert matches(filter_, topic) is wanted, (filter_, topic)
        have = zenoh.KeyExpr(filter_to_key(filter_)).intersects(zenoh.KeyExpr(topic_to_key(topic)))
        assert have == wanted, (filter_, topic)
    assert matched > 60


def test_every_topic_comes_back_and_no_two_share_a_key() -> None:
    dice = random.Random(2)
    topics = {random_topic(dice) for _ in range(3_000)}
    keys = {topic_to_key(topic) for topic in topics}
    assert len(keys) == len(topics)
    assert {key_to_topic(key) for key in keys} == topics


@pytest.mark.parametrize(
    ("topic", "key"),
    [
        *((same, same) for same in ("pebble/robots/goob/incoming/drive-values", "Fred's lamp/über", "a-b_c.d")),
        *(("/a//b/", "%/a/%/b/%"), ("@a/@", "%40a/%40"), ("50%", "50%25"), ("$SYS/x", "@%24SYS/x"), ("a/$x", "a/%24x")),
    ],
)
def test_only_what_zenoh_forbids_is_escaped(topic: str, key: str) -> None:
    assert topic_to_key(topic) == key


def test_no_topic_maps_to_the_hubs_own_keys() -> None:
    for filter_ in ("#", "+/#", "@retain/#", "+/+", "@hub/hello"):
        assert not zenoh.KeyExpr(filter_to_key(filter_)).intersects(zenoh.KeyExpr("@retain/a"))
        assert not zenoh.KeyExpr(filter_to_key(filter_)).intersects(zenoh.KeyExpr("@hub/hello"))
