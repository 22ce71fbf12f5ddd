"""Which frames are sent: the wanted rate, whatever the camera's rate and however unpunctual it is."""

from __future__ import annotations

import random
from itertools import pairwise

import pytest

from pebble.services.camera_publisher.frame_selector import FrameSelector

SECONDS = 120


def captures(fps: float, jitter_s: float, *, lost: float = 0.0) -> list[float]:
    """Times of a camera's frames: each off its beat by up to ``jitter_s``, a share of them ``lost``."""
    dice = random.Random(1)
    times = [1000 + number / fps + dice.uniform(-jitter_s, jitter_s) for number in range(round(SECONDS * fps))]
    return sorted(time for time in times if dice.random() >= lost)


def taken(pacer: FrameSelector, times: list[float]) -> list[float]:
    chosen = []
    for time in times:
        if pacer.due(time):
            pacer.use(time)
            chosen.append(time)
    return chosen


@pytest.mark.parametrize("jitter_s", [0.0, 0.010, 0.030])
@pytest.mark.parametrize(("camera", "wanted"), [(10, 10), (10.05, 10), (15, 10), (29.97, 15), (30, 7)])
def test_the_wanted_rate_is_what_comes_out(camera: float, wanted: float, jitter_s: float) -> None:
    chosen = taken(FrameSelector(wanted), captures(camera, jitter_s))
    assert len(chosen) / SECONDS == pytest.approx(min(camera, wanted), rel=0.01)


def test_a_slower_camera_is_sent_whole_and_a_lost_frame_is_made_up_for() -> None:
    times = captures(9.5, 0.020)
    assert len(taken(FrameSelector(10), times)) >= 0.995 * len(times)
    chosen = taken(FrameSelector(10), captures(30, 0.003, lost=0.2))
    assert len(chosen) / SECONDS == pytest.approx(10, rel=0.01)


def test_a_pause_is_not_made_up_for() -> None:
    times = [*captures(30, 0.0)[:300], *(time + 60 for time in captures(30, 0.0)[300:600])]
    assert len(taken(FrameSelector(10), times)) <= 202


def test_a_turn_is_used_up_by_what_is_sent_and_another_rate_counts_from_now_on() -> None:
    pacer = FrameSelector(10)
    pacer.use(0.0)
    assert [pacer.due(at) for at in (0.03, 0.1, 0.133)] == [False, True, True]
    pacer = FrameSelector(1)
    pacer.use(0.0)
    assert not pacer.due(0.4)
    pacer.fps = 10
    assert pacer.fps == pytest.approx(10)
    assert [pacer.due(at) for at in (0.45, 0.5)] == [False, True]


def test_a_clock_that_went_back_begins_anew() -> None:
    pacer = FrameSelector(10)
    chosen = taken(pacer, captures(30, 0.0)[:30])
    assert len(chosen) == 10
    assert all(after - before == pytest.approx(0.1, abs=1e-6) for before, after in pairwise(chosen)), "evenly"
    assert pacer.due(5.0)
