"""Rates and ages over the last seconds, and of messages that are not acknowledged."""

from __future__ import annotations

import math

import pytest

from pebble.extensions.media.in_flight import InFlight
from pebble.extensions.media.rate_meter import WINDOW_S, RateMeter


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
    assert len(messages.acknowledge(20)) == 3, "a ping is no message"
    assert (messages.oldest, messages.age_s(1.0)) == (None, 0)
    messages.sent(600, 2.0)
    messages.clear()
    assert messages.age_s(3.0) == 0, "a lost connection loses its messages"
    messages = InFlight(slack=0, limit=2)
    for number in range(3):
        messages.sent(100, float(number))
    assert messages.age_s(3.0) == 2.0, "only so many are remembered"
