"""What the audio publisher makes of a slow link, on a clock of its own."""

from __future__ import annotations

import pytest

from pebble.services.audio_publisher.sender import encoding_of
from pebble.services.audio_publisher.thrift import Step, Thrift, steps
from pebble.services.audio_publisher.under_way import UnderWay


def watch(thrift: Thrift, age_s: float, begin: float, seconds: float) -> list[float]:
    """A look every 20 ms; returns when the level changed."""
    return [
        round(at, 2)
        for at in (begin + 0.02 * number for number in range(round(50 * seconds)))
        if thrift.look(age_s, at)
    ]


def test_steps_save_headers_first_and_then_bits() -> None:
    assert [(step.bundle, step.bitrate) for step in steps(1, 24_000)] == [(1, 24_000), (3, 24_000), (3, 16_000)]
    assert [(step.bundle, step.bitrate) for step in steps(3, 24_000)] == [(3, 24_000), (3, 16_000)]
    assert steps(3, 12_000) == (Step(3, 12_000),)


def at_ease() -> Thrift:
    """One that has found out, by 5.0, that the link takes everything."""
    thrift = Thrift(2, 0.0)
    watch(thrift, 0.0, 0.0, 5.0)
    assert thrift.level == 0
    return thrift


def test_it_begins_small_and_has_everything_soon() -> None:
    thrift = Thrift(2, 0.0)
    assert thrift.level == 2
    assert len(watch(thrift, 0.06, 0.0, 2.5)) == 2
    assert thrift.level == 0


def test_time_in_which_nothing_was_seen_earns_nothing() -> None:
    thrift = Thrift(2, 1.0)  # and no connection until 20.0
    assert watch(thrift, 0.0, 20.0, 0.9) == []
    assert len(watch(thrift, 0.0, 20.9, 2.0)) == 2
    watch(thrift, 0.18, 60.0, 2.0)
    assert watch(thrift, 0.0, 200.0, 9.0) == []


def test_confirmations_that_are_held_back_are_not_a_slow_link() -> None:
    thrift = Thrift(2, 0.0)
    for number in range(250):
        now = 0.02 * number
        thrift.look(0.01 + now % 0.1024, now)
    assert thrift.level == 0


def test_what_stands_in_a_queue_earns_nothing() -> None:
    thrift = Thrift(2, 0.0)
    assert watch(thrift, 0.09, 0.0, 60) == []


def test_a_link_that_is_fast_changes_nothing() -> None:
    thrift = at_ease()
    assert watch(thrift, 0.06, 5.0, 600) == []


def test_on_a_link_that_begins_slow_it_stays_small() -> None:
    thrift = Thrift(2, 0.0)
    assert watch(thrift, 0.18, 0.0, 60) == []


def test_slowness_goes_down_step_by_step() -> None:
    thrift = at_ease()
    changes = watch(thrift, 0.18, 10.0, 10)
    assert len(changes) == 2
    assert changes[-1] < 10 + 1, "commands wait behind what waits"
    assert thrift.level == 2


def test_a_moment_of_slowness_is_nothing() -> None:
    thrift = at_ease()
    for begin in range(10, 100):
        assert watch(thrift, 0.19, begin, 0.2) == []
        assert watch(thrift, 0.0, begin + 0.2, 0.8) == []


def test_steps_back_are_tried_ever_more_rarely() -> None:
    thrift = at_ease()
    watch(thrift, 0.18, 10.0, 3.0)
    tries, at = [], 13.0
    for _ in range(4):
        begin = at
        while thrift.level == 2:
            at += 0.02
            thrift.look(0.0, at)
        tries.append(at - begin)
        while thrift.level == 1:
            at += 0.02
            thrift.look(0.18, at)
    assert tries[0] > 5
    assert tries == sorted(tries)
    assert tries[-1] > 4 * tries[0]


def test_all_is_as_before_in_the_end() -> None:
    thrift = at_ease()
    watch(thrift, 0.18, 10.0, 5.0)
    watch(thrift, 0.0, 15.0, 100)
    assert thrift.level == 0


def test_age_of_what_is_not_confirmed() -> None:
    under_way = UnderWay()
    assert under_way.age_s(5000, 0.0) == 0
    for number in range(10):
        under_way.sent(600, number / 10)
    assert under_way.age_s(10 * 650, 1.0) == pytest.approx(1.0)
    assert under_way.age_s(3 * 650, 1.0) == pytest.approx(0.3)
    assert under_way.age_s(20, 1.0) == 0  # a ping
    under_way.sent(600, 2.0)
    under_way.clear()
    assert under_way.age_s(600, 3.0) == 0


def test_what_a_request_means() -> None:
    assert [encoding_of(asked, "opus") for asked in ("pcm", "opus", "mp3", None)] == ["pcm", "opus", "opus", "opus"]
