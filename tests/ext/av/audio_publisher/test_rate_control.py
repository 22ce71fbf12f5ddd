"""What the audio publisher reduces on a slow connection, on a clock of its own."""

from __future__ import annotations

import pytest

from pebble.services.audio_publisher.rate_control import LevelControl, Step, steps


def watch(levels: LevelControl, age_s: float, begin: float, seconds: float) -> list[float]:
    """A poll every 20 ms; returns when the level changed."""
    return [
        round(at, 2)
        for at in (begin + 0.02 * number for number in range(round(50 * seconds)))
        if levels.poll(age_s, at)
    ]


def test_steps_save_headers_first_and_then_bits() -> None:
    assert [(step.bundle, step.bitrate) for step in steps(1, 24_000)] == [(1, 24_000), (3, 24_000), (3, 16_000)]
    assert [(step.bundle, step.bitrate) for step in steps(3, 24_000)] == [(3, 24_000), (3, 16_000)]
    assert steps(3, 12_000) == (Step(3, 12_000),)


def at_ease() -> LevelControl:
    """Return a control that has learnt by 5.0 that the link takes everything, but for moments."""
    levels = LevelControl(2, 0.0)
    watch(levels, 0.0, 0.0, 5.0)
    assert levels.level == 0
    return levels


#: How old what waits is, for so many seconds from the start, the changes of the level meanwhile, and the level then.
FROM_THE_START = {
    "it begins small and has everything soon": (0.06, 2.5, 2, 0),
    "what stands in a queue earns nothing": (0.09, 60, 0, 2),
    "on a link that begins slow it stays small": (0.18, 60, 0, 2),
}


@pytest.mark.parametrize(("age_s", "seconds", "changes", "level"), FROM_THE_START.values(), ids=FROM_THE_START)
def test_from_the_start(age_s: float, seconds: float, changes: int, level: int) -> None:
    levels = LevelControl(2, 0.0)
    assert levels.level == 2
    assert (len(watch(levels, age_s, 0.0, seconds)), levels.level) == (changes, level)


def test_time_in_which_nothing_was_seen_earns_nothing() -> None:
    levels = LevelControl(2, 1.0)  # and no connection until 20.0
    assert watch(levels, 0.0, 20.0, 0.9) == []
    assert len(watch(levels, 0.0, 20.9, 2.0)) == 2
    watch(levels, 0.18, 60.0, 2.0)
    assert watch(levels, 0.0, 200.0, 9.0) == []


def test_confirmations_that_are_held_back_are_not_a_slow_link() -> None:
    levels = LevelControl(2, 0.0)
    for number in range(250):
        now = 0.02 * number
        levels.poll(0.01 + now % 0.1024, now)
    assert levels.level == 0


def test_slowness_goes_down_step_by_step_and_all_is_as_before_in_the_end() -> None:
    levels = at_ease()
    for begin in range(5, 100):
        assert watch(levels, 0.19, begin, 0.2) == [], "a moment of slowness is nothing"
        assert watch(levels, 0.06, begin + 0.2, 0.8) == [], "a fast link changes nothing"
    changes = watch(levels, 0.18, 110.0, 10)
    assert (len(changes), levels.level) == (2, 2)
    assert changes[-1] < 110 + 1, "commands wait behind what waits"
    watch(levels, 0.0, 120.0, 100)
    assert levels.level == 0


def test_steps_back_are_tried_ever_more_rarely() -> None:
    levels = at_ease()
    watch(levels, 0.18, 10.0, 3.0)
    tries, at = [], 13.0
    for _ in range(4):
        begin = at
        while levels.level == 2:
            at += 0.02
            levels.poll(0.0, at)
        tries.append(at - begin)
        while levels.level == 1:
            at += 0.02
            levels.poll(0.18, at)
    assert tries[0] > 5
    assert tries == sorted(tries)
    assert tries[-1] > 4 * tries[0]
