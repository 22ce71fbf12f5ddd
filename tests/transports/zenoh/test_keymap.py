"""Filters and topics, and their Zenoh keys, against paho's matcher and Zenoh's own (T1)."""

from __future__ import annotations

import random

import pytest
import zenoh
from paho.mqtt.client import topic_matches_sub

from pebble.transports.topics import matches
from pebble.transports.zenoh.keymap import filter_to_key, key_to_topic, topic_to_key
from tests.support import cases

LEVELS = ["", "a", "b", "ab", "@", "@a", "$", "$a", "%", "%40", "*", "**", "a*", "?"]
LEVELS += ["%25", "ä", "a b", "@retain", "$*"]


def random_filter(dice: random.Random) -> str:
    levels = dice.choices([*LEVELS, "+", "+", "a", "a"], k=dice.randint(1, 4))
    return "/".join([*levels, *dice.choice(([], [], ["#"]))]) or "#"


def random_topic(dice: random.Random) -> str:
    return "/".join(dice.choices([*LEVELS, "a", "a", "a"], k=dice.randint(1, 5))) or "a"


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


def test_keys_are_canonical_for_zenoh() -> None:
    dice = random.Random(3)
    for _ in range(500):
        key = filter_to_key(random_filter(dice))
        assert str(zenoh.KeyExpr.autocanonize(key)) == key


@pytest.mark.parametrize("topic", ["pebble/robots/goob/incoming/drive-values", "Fred's lamp/über", "a-b_c.d"])
def test_ordinary_topics_are_their_own_keys(topic: str) -> None:
    assert topic_to_key(topic) == topic


@pytest.mark.parametrize(
    ("topic", "key"),
    [("/a//b/", "%/a/%/b/%"), ("@a/@", "%40a/%40"), ("50%", "50%25"), ("$SYS/x", "@%24SYS/x"), ("a/$x", "a/%24x")],
)
def test_what_zenoh_forbids_is_escaped(topic: str, key: str) -> None:
    assert topic_to_key(topic) == key


def test_no_topic_maps_to_the_hubs_own_keys() -> None:
    for filter_ in ("#", "+/#", "@retain/#", "+/+", "@hub/hello"):
        assert not zenoh.KeyExpr(filter_to_key(filter_)).intersects(zenoh.KeyExpr("@retain/a"))
        assert not zenoh.KeyExpr(filter_to_key(filter_)).intersects(zenoh.KeyExpr("@hub/hello"))
