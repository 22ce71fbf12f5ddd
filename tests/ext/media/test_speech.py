"""The synthetic voice: the same everywhere, loud enough, and with the ups and downs that encoders rely on."""

from __future__ import annotations

import numpy as np
import pytest

from pebble.extensions.media.speech import PERIOD_S, Speech


def test_any_piece_is_cut_from_the_same_sound() -> None:
    speech = Speech(16_000)
    whole = speech.samples(0, 16_000 * PERIOD_S)
    assert np.array_equal(speech.samples(48_123, 320), whole[48_123 : 48_123 + 320])
    assert np.array_equal(
        speech.samples(16_000 * PERIOD_S * 1000 - 100, 200), np.concatenate([whole[-100:], whole[:100]])
    )


@pytest.mark.parametrize("rate", [4_000, 8_000, 11_025, 16_000, 44_100, 48_000])
def test_it_is_neither_silent_nor_clipped_at_any_rate(rate: int) -> None:
    samples = Speech(rate).samples(0, rate * PERIOD_S).astype(float)
    assert 10_000 < np.abs(samples).max() < 20_000
    assert 500 < np.sqrt(np.mean(samples**2)) < 8_000
