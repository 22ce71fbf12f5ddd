"""Rates and ages over the last seconds."""

from __future__ import annotations

import threading

import pytest

from pebble.media.figures import WINDOW_S, Figures


def test_rate_bitrate_and_age() -> None:
    figures = Figures()
    for number in range(21):
        figures.add(number / 10, 1000, 0.040 + number / 1000)
    assert figures.rate(2.0) == pytest.approx(10)
    assert figures.bitrate(2.0) == pytest.approx(80_000)
    assert figures.age_s(2.0) == pytest.approx(0.050)
    assert figures.total == 21


def test_what_is_long_ago_does_not_count() -> None:
    figures = Figures()
    for number in range(10):
        figures.add(number / 10, 1000, None)
    assert figures.rate(1 + 2 * WINDOW_S) == 0
    assert figures.bitrate(1 + 2 * WINDOW_S) == 0
    assert figures.age_s(1) is None


def test_one_message_makes_no_rate() -> None:
    figures = Figures()
    figures.add(0.0, 10, None)
    assert figures.rate(0.0) == 0


def test_one_thread_may_tell_while_another_looks() -> None:
    figures, ending = Figures(), threading.Event()

    def tell() -> None:
        while not ending.is_set():
            figures.add(1.0, 1000, 0.01)

    telling = threading.Thread(target=tell)
    telling.start()
    try:
        for _ in range(2000):
            figures.rate(1.0)
            figures.age_s(1.0)
    finally:
        ending.set()
        telling.join()
