"""What is reduced on slow connections: simulated ones, from 64 kbit/s to 2 Mbit/s, that change while pictures flow."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from math import ceil

import pytest

from pebble.extensions.media.in_flight import InFlight
from pebble.extensions.media.rate_meter import WINDOW_S, RateMeter
from pebble.services.camera_publisher.frame_selector import FrameSelector
from pebble.services.camera_publisher.rate_control import STEPS, LevelControl, RateController
from pebble.services.camera_publisher.send_window import Acknowledged, SendWindow
from pebble.transports.base import Outgoing
from pebble.transports.counters import Counters

KILOBIT = 125.0  # bytes


@dataclass
class Run:
    """A publisher, a link of ``kbits(now)`` and ``delay_s`` each way; a full frame has ``full`` bytes, every third
    one is a full picture and twice that. Confirmations wait for the next multiple of ``beacon_s``."""

    kbits: Callable[[float], float]
    full: int = 9_000
    fps: float = 10.0
    delay_s: float = 0.01
    beacon_s: float = 0.0
    thin: bool = False
    ages: list[tuple[float, float]] = field(default_factory=list)  # when a frame had arrived whole, and its age then
    levels: list[tuple[float, int]] = field(default_factory=list)
    busy_s: float = 0.0  # so long something was on its way out

    def run(self, seconds: float, *, step_s: float = 0.005) -> Run:
        waiting, now, camera = 0.0, 0.0, 0.0
        rate = RateController(
            self.fps, 0.0, lambda: Outgoing(round(waiting), 2 * self.delay_s), Counters(), thin=self.thin
        )
        unsent, frames, number = 0.0, list[list[float]](), 0
        confirmed: list[tuple[float, float]] = []  # when the confirmation of so many bytes arrives
        while now < seconds:
            now += step_s
            went = min(unsent, self.kbits(now) * KILOBIT * step_s)
            unsent -= went
            self.busy_s += step_s * (unsent > 0)
            if went:
                back = now + 2 * self.delay_s
                confirmed.append((self.beacon_s * ceil(back / self.beacon_s) if self.beacon_s else back, went))
            while confirmed and confirmed[0][0] <= now:
                waiting -= confirmed.pop(0)[1]
            while went and frames:
                part = min(went, frames[0][0])
                frames[0][0] -= part
                went -= part
                if frames[0][0] > 1e-6:
                    break
                self.ages.append((now, now + self.delay_s - frames.pop(0)[1]))
            step = rate.poll(now)
            if step is not None:
                self.levels.append((now, STEPS.index(step)))
            if now < camera:
                continue
            camera += 1 / 30
            if rate.may_encode(now, now):
                size = self.full * rate.step.bytes * (2 if number % 3 == 0 else 1)
                number += 1
                rate.sent(round(size), now)
                frames.append([size, now])
                unsent += size
                waiting += size
        return self

    def worst_age(self, begin: float, end: float = 1e9) -> float:
        return max(age for at, age in self.ages if begin <= at <= end)

    def rate(self, begin: float, end: float) -> float:
        return sum(begin <= at < end for at, _ in self.ages) / (end - begin)

    def level_at(self, when: float) -> int:
        return next((level for at, level in reversed(self.levels) if at <= when), 0)


@pytest.mark.parametrize(("kbits", "delay_s"), [(64, 0.2), (256, 0.05), (2000, 0.001)])
def test_pictures_stay_young_on_any_link(kbits: int, delay_s: float) -> None:
    run = Run(lambda _now: kbits, delay_s=delay_s).run(60)
    assert run.worst_age(0) < 3.5  # the very first, at full size
    assert run.worst_age(4) < 0.9 + delay_s
    assert run.rate(10, 60) > 2


@pytest.mark.parametrize(("kbits", "delay_s"), [(9.6, 0.3), (64, 0.05)])
def test_on_a_thin_link_a_slow_picture_is_followed_by_a_rest(kbits: float, delay_s: float) -> None:
    """What is sent during the rest of the time finds the modem empty."""
    run = Run(lambda _now: kbits, full=40_000, delay_s=delay_s, thin=True).run(120)
    assert len(run.ages) >= 3
    assert run.busy_s < 0.25 * 120
    assert run.worst_age(0) < 20_000 / (kbits * KILOBIT)  # the first one is small, too


def test_the_rate_is_the_last_to_go() -> None:
    run = Run(lambda _now: 256).run(60)
    assert run.rate(10, 60) == pytest.approx(10, rel=0.04)
    assert 0 < run.level_at(30) < 7


@pytest.mark.parametrize(("kbits", "delay_s", "thin"), [(2000, 0.01, False), (20_000, 0.4, False), (8000, 0.01, True)])
def test_a_good_link_gets_everything_and_a_long_way_is_not_a_slow_link(kbits: int, delay_s: float, thin: bool) -> None:
    run = Run(lambda _now: kbits, delay_s=delay_s, thin=thin).run(60)
    assert bool(run.levels) is thin
    assert run.level_at(15) == 0
    assert run.rate(15, 60) == pytest.approx(10, rel=0.02)


@pytest.mark.parametrize(("fps", "beacon_s"), [(10.0, 0.0666), (30.0, 0.1024)])
def test_confirmations_that_are_held_back_are_not_a_slow_link(fps: float, beacon_s: float) -> None:
    run = Run(lambda _: 20_000, full=4_000, fps=fps, delay_s=0.002, beacon_s=beacon_s).run(30)
    assert run.rate(2, 30) > 0.95 * fps
    assert run.level_at(20) == 0  # the first second may be misunderstood


def test_a_slow_link_is_noticed_behind_confirmations_that_are_held_back() -> None:
    run = Run(lambda _: 64, delay_s=0.002, beacon_s=0.1024).run(40)
    assert run.worst_age(5) < 0.8


def test_a_link_that_breaks_down_is_answered_at_once_and_gets_everything_back_when_it_recovers() -> None:
    run = Run(lambda now: 128 if 20 < now < 60 else 4000).run(200)
    assert run.worst_age(0, 20) < 0.3
    assert run.worst_age(20) < 1.6
    assert run.worst_age(23) < 0.9
    assert run.level_at(59) >= 3
    assert run.level_at(199) == 0
    assert run.rate(180, 200) == pytest.approx(10, rel=0.02)
    assert str(STEPS[-1]) == "quality 1/2, size 1/4, rate 1/8"
    assert all(before.cost > after.cost for before, after in pairwise(STEPS))


def test_a_steady_link_is_not_probed_all_the_time() -> None:
    run = Run(lambda _now: 300).run(160)
    assert len([at for at, _ in run.levels if at > 60]) <= 7


def test_frames_sent_before_a_change_do_not_count() -> None:
    levels = LevelControl(10, 0.0)
    assert levels.poll([], 0.6, 1.0)
    level = levels.level
    assert not levels.poll([Acknowledged(0.4, 5.0)], 0.0, 5.4)
    assert not levels.poll([], 5.0, 5.5)
    assert levels.level == level


class TestSendWindow:
    def test_bytes_are_confirmed_in_order(self) -> None:
        queue = SendWindow()
        queue.sent(1000, 1.0)
        queue.sent(2000, 2.0)
        assert not queue.poll(3000, 0.0, 2.5)
        assert not queue.poll(2500, 0.0, 2.5)
        assert [frame.sent_at for frame in queue.poll(2000, 0.0, 3.0)] == [1.0]
        assert queue.age_s(0.0, 3.05) == pytest.approx(1.0)
        assert [frame.took_s for frame in queue.poll(0, 0.1, 4.1)] == [pytest.approx(1.1)]
        assert queue.age_s(0.0, 9.0) == 0.0
        queue.sent(1000, 1.0)
        queue.clear()
        assert queue.age_s(0.0, 100.0) == 0.0, "a lost connection takes everything along"

    @pytest.mark.parametrize(("real_s", "counted_s"), [(0.05, 0.0), (0.075, 0.0375), (0.1, 0.1), (3.0, 3.0)])
    def test_short_times_may_be_a_late_acknowledgement(self, real_s: float, counted_s: float) -> None:
        queue = SendWindow()
        queue.sent(1000, 1.0)
        assert [frame.took_s for frame in queue.poll(0, 0.2, 1.2 + real_s)] == [pytest.approx(counted_s, abs=1e-6)]

    def test_what_arrives_after_a_long_way_is_not_held_back(self) -> None:
        queue = SendWindow()
        queue.poll(0, 0.3, 0.9)
        for now in (1.0, 1.01):
            queue.sent(1000, now)
        assert [len(queue.poll(waiting, 0.3, now)) for waiting, now in ((2000, 1.31), (0, 1.32))] == [0, 2]
        queue.sent(1000, 2.0)
        assert not queue.full(0.3, 2.4), "one more shows whether this one is held back"
        assert [frame.took_s for frame in queue.poll(0, 0.3, 2.4)] == [pytest.approx(0.1)]

    def test_a_transport_that_measures_nothing_never_holds_anything_back(self) -> None:
        queue = SendWindow()
        for number in range(100):
            queue.sent(10_000, number)
            assert len(queue.poll(0, 0.0, number)) == 1
        assert queue.age_s(0.0, 1e6) == 0.0


# -- which frames are sent


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


# -- rates and ages over the last seconds, and of messages that are not acknowledged


def test_rate_bitrate_and_age_of_the_window() -> None:
    meter = RateMeter()
    for _ in range(2):  # fewer than two messages make no rate, and two at the same moment neither
        assert (meter.rate(0.0), meter.bitrate(0.0)) == (0, 0)
        meter.add(0.0, 1000, 0.040)
    assert (meter.rate(0.0), meter.bitrate(0.0)) == (0, 0)
    meter.clear()
    for number in range(21):
        meter.add(number / 10, 1000, 0.040 + number / 1000)
    assert meter.rate(2.0) == pytest.approx(10)
    assert meter.bitrate(2.0) == pytest.approx(80_000)
    assert meter.age_s(2.0) == pytest.approx(0.050)
    later = 3 + 2 * WINDOW_S
    assert (meter.rate(later), meter.bitrate(later), RateMeter().age_s(later)) == (0, 0, None)


def test_only_the_newest_messages_count() -> None:
    meter = RateMeter(window_s=math.inf, limit=11)
    for number in range(100):
        meter.add(max(0, number - 80) / 4)
    assert meter.rate(1e6) == pytest.approx(4)
    assert len(meter.arrivals(1e6)) == 11
    assert meter.count == 100


def test_messages_are_acknowledged_in_order() -> None:
    messages = InFlight(slack=60)
    assert messages.acknowledge(5000) == []
    for number in range(10):
        messages.sent(660, number / 10)
    assert messages.acknowledge(10 * 650) == []
    assert messages.age_s(1.0) == pytest.approx(1.0)
    assert [message.at for message in messages.acknowledge(3 * 650)] == [number / 10 for number in range(7)]
    assert messages.age_s(1.0) == pytest.approx(0.3)
    assert len(messages) == 3
    assert len(messages.acknowledge(60)) == 3, "pings are no message"
    assert (messages.oldest, messages.age_s(1.0)) == (None, 0)
    messages.sent(600, 2.0)
    messages.clear()
    assert messages.age_s(3.0) == 0, "a lost connection loses its messages"
    messages = InFlight(slack=0, limit=2)
    for number in range(3):
        messages.sent(100, float(number))
    assert messages.age_s(3.0) == 2.0, "only so many are remembered"
