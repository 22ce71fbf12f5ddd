"""The conditions are the paper's."""

from pebble.bench.impair.conditions import CONDITIONS, Shape

NAMES = [
    *("base-start", "1024k", "512k", "256k", "128k", "64k", "1%", "2%", "5%", "10%"),
    *("256k+1%", "128k+2%", "64k+5%", "base-end"),
]


def test_the_trials_are_the_papers_and_only_the_uplink_is_shaped() -> None:
    assert [condition.name for condition in CONDITIONS] == NAMES
    assert {condition.down for condition in CONDITIONS} == {Shape()}


def test_names_match_their_shapes() -> None:
    shapes = {condition.name: condition.up for condition in CONDITIONS}
    assert shapes["base-start"] == shapes["base-end"] == Shape()
    assert shapes["512k"] == Shape(kbit=512)
    assert shapes["10%"] == Shape(loss=0.1)
    assert shapes["64k+5%"] == Shape(kbit=64, loss=0.05)
