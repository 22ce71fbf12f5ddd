"""The synthetic voice: the same everywhere, loud enough, and with the ups and downs that encoders rely on."""

from __future__ import annotations

import numpy as np

from pebble.extensions.media.speech import PERIOD_S, Speech


def test_any_piece_is_cut_from_the_same_sound() -> None:
    speech = Speech(16_000)
    whole = speech.samples(0, 16_000 * PERIOD_S)
    assert np.array_equal(speech.samples(48_123, 320), whole[48_123 : 48_123 + 320])
    assert np.array_equal(
        speech.samples(16_000 * PERIOD_S * 1000 - 100, 200), np.concatenate([whole[-100:], whole[:100]])
    )
