"""The server's memory of what pages plot: thinned, bounded, and small enough for one message."""

from __future__ import annotations

import itertools
import json
from typing import Any

import msgspec
import pytest

from pebble.transports import Message
from pebble.web import messages as m
from pebble.web import recent as module
from pebble.web.recent import LIMITS, MESSAGE_BYTES, Recent
from pebble.web.server import encode
from tests.recordings.demo_robots import DRIVE, GOOB, MINILAMP, received
from tests.recordings.demo_robots import values as values_of

REF = "pebble/robots/goob"
IMU, TOUCH, BATTERY, ODOMETRY = "sensors/imu", "touch-sensors", "charging-level", "wheel-odometry"


def message(value: Any, *, retain: bool = False) -> Message:
    return Message("topic", value if isinstance(value, bytes) else json.dumps(value).encode(), retain=retain)


def filled(metric: str, period_s: float, count: int, *, ref: str = REF, recent: Recent | None = None) -> Recent:
    """A history with the numbers 0, 1, 2 … at their times; the component is open."""
    recent = recent or Recent()
    recent.open(ref)
    for number in range(count):
        recent.receive(ref, metric, message(number), number * period_s)
    return recent


def values(recent: Recent, metric: str, now: float, ref: str = REF) -> list[tuple[float, int]]:
    return [(age, msgspec.json.decode(value)) for age, value in recent.points(ref, metric, now)]


def test_values_have_their_age() -> None:
    assert values(filled(IMU, 0.2, 3), IMU, 1.0) == [(1000, 0), (800, 1), (600, 2)]


def test_what_is_too_old_is_left_out() -> None:
    assert [number for _, number in values(filled(IMU, 10, 20), IMU, 190)] == list(range(7, 20))


def test_fast_ones_are_thinned_to_their_rate() -> None:
    shown = values(filled(TOUCH, 0.02, 500), TOUCH, 10)  # 50 Hz for 10 s, at most 20 are remembered
    assert 195 <= len(shown) <= 202
    shown = values(filled(ODOMETRY, 0.05, 200), ODOMETRY, 10)
    assert 98 <= len(shown) <= 102


@pytest.mark.parametrize("opened", [(), (GOOB,)], ids=["closed", "open"])
def test_of_recorded_robots_what_is_plotted_is_remembered(opened: tuple[str, ...]) -> None:
    """Robots that no page has open have their battery alone."""
    recent, sent = Recent(), received(DRIVE)
    for ref in opened:
        recent.open(ref)
    for at, one in sent:
        ref, _, metric = one.topic.partition("/outgoing/")
        recent.receive(ref, metric, one, at)
    assert recent.metrics(MINILAMP) == [BATTERY]
    assert recent.metrics(GOOB) == [BATTERY, *([IMU] * len(opened))]
    for metric in recent.metrics(GOOB):
        remembered = [msgspec.json.decode(value) for _, value in recent.points(GOOB, metric, sent[-1][0])]
        published = values_of(DRIVE, f"{GOOB}/outgoing/{metric}")
        assert remembered == published
        assert len(published) >= 3


def test_a_component_that_is_closed_or_removed_takes_no_room() -> None:
    recent = filled(IMU, 0.2, 10)
    recent.receive(REF, BATTERY, message(1), 0)
    recent.close(REF)
    assert recent.metrics(REF) == [BATTERY]
    recent.forget(REF)
    assert recent.bytes == 0


def test_retained_and_long_values_are_left_out() -> None:
    recent = Recent()
    recent.receive(REF, BATTERY, message(1, retain=True), 0)
    recent.receive(REF, BATTERY, message(b"1" * 2049), 0)
    assert recent.metrics(REF) == []


def test_each_metric_fits_into_one_message_evenly() -> None:
    recent = Recent()
    recent.open(REF)
    for number in range(600):
        recent.receive(REF, IMU, message({"n": number, "text": "x" * (40 + 400 * (number % 3 == 0))}), number * 0.2)
    points = recent.points(REF, IMU, 120)
    text = encode(m.Series(ref=REF, metric=IMU, now=0, points=points))
    assert len(text) < MESSAGE_BYTES + 500
    numbers = [json.loads(bytes(value))["n"] for _, value in points]
    assert numbers[-1] == 599
    steps = {b - a for a, b in itertools.pairwise(numbers)}
    assert len(steps) == 1
    assert len(numbers) > 40


def test_all_of_them_are_bounded_in_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MESSAGE_BYTES", 10**9)  # all of them are seen
    recent = Recent()
    value = message(b'"' + b"x" * 2000 + b'"')
    for number in range(200):
        for metric in LIMITS:
            recent.open(f"a/b/{number}")
            for at in range(120):
                recent.receive(f"a/b/{number}", metric, value, float(at))
    assert recent.bytes <= module.MAX_BYTES
    held = [point for number in range(200) for one in LIMITS for point in recent.points(f"a/b/{number}", one, 119.0)]
    assert module.MAX_BYTES / 2 < sum(len(bytes(value)) for _, value in held) < module.MAX_BYTES
    for number in range(200):
        recent.forget(f"a/b/{number}")
    assert recent.bytes == 0
