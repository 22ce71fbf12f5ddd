"""Rates and ages over the last seconds."""

from __future__ import annotations

import math

import pytest

from pebble.extensions.media.rate_meter import WINDOW_S, RateMeter


def test_rate_bitrate_and_age() -> None:
    meter = RateMeter()
    for number in range(21):
        meter.add(number / 10, 1000, 0.040 + number / 1000)
    assert meter.rate(2.0) == pytest.approx(10)
    assert meter.bitrate(2.0) == pytest.approx(80_000)
    assert meter.age_s(2.0) == pytest.approx(0.050)
    assert meter.count == 21


def test_messages_before_the_window_do_not_count() -> None:
    meter = RateMeter()
    for number in range(10):
        meter.add(number / 10, 1000)
    assert meter.rate(1 + 2 * WINDOW_S) == 0
    assert meter.bitrate(1 + 2 * WINDOW_S) == 0
    assert meter.age_s(1) is None


def test_only_the_newest_messages_count() -> None:
    meter = RateMeter(window_s=math.inf, limit=11)
    for number in range(100):
        meter.add(max(0, number - 80) / 4)
    assert meter.rate(1e6) == pytest.approx(4)
    assert len(meter.arrivals(1e6)) == 11
    assert meter.count == 100


def test_fewer_than_two_messages_make_no_rate() -> None:
    meter = RateMeter()
    assert (meter.rate(0.0), meter.bitrate(0.0)) == (0, 0)
    meter.add(0.0, 10)
    assert (meter.rate(0.0), meter.bitrate(0.0)) == (0, 0)
    meter.add(0.0, 10)  # at the same moment
    assert (meter.rate(0.0), meter.bitrate(0.0)) == (0, 0)


def test_a_cleared_meter_begins_again() -> None:
    meter = RateMeter()
    for number in range(10):
        meter.add(number / 10, 1000)
    meter.clear()
    assert meter.rate(1.0) == 0
    meter.add(1.0)
    meter.add(1.5)
    assert meter.rate(1.5) == pytest.approx(2)
