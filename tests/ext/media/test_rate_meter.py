"""Rates and ages over the last seconds."""

from __future__ import annotations

import math

import pytest

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
