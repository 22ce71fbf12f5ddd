"""The synthetic voice: the same everywhere, loud enough, and with the ups and downs that encoders rely on."""

from __future__ import annotations

import numpy as np
import pytest

from pebble.extensions.media.scene import noise
from pebble.extensions.media.speech import PERIOD_S, Speech


def test_any_piece_is_cut_from_the_same_sound() -> None:
    speech = Speech(16_000)
    whole = speech.samples(0, 16_000 * PERIOD_S)
    assert np.array_equal(speech.samples(48_123, 320), whole[48_123 : 48_123 + 320])
    assert np.array_equal(
        speech.samples(16_000 * PERIOD_S * 1000 - 100, 200), np.concatenate([whole[-100:], whole[:100]])
    )


@pytest.mark.parametrize("channels", [1, 2, 8])
def test_all_channels_are_the_same(channels: int) -> None:
    samples = Speech(8_000, channels).samples(100, 160)
    assert samples.shape == (160, channels)
    assert samples.dtype == np.int16
    assert (samples == samples[:, :1]).all()


@pytest.mark.parametrize("rate", [4_000, 8_000, 11_025, 16_000, 44_100, 48_000])
def test_it_is_neither_silent_nor_clipped_at_any_rate(rate: int) -> None:
    samples = Speech(rate).samples(0, rate * PERIOD_S).astype(float)
    assert 10_000 < np.abs(samples).max() < 20_000
    assert 500 < np.sqrt(np.mean(samples**2)) < 8_000


def test_it_has_syllables_and_pauses() -> None:
    loudness = np.sqrt((Speech(16_000).samples(0, 160_000)[:, 0].reshape(-1, 160).astype(float) ** 2).mean(axis=1))
    assert np.mean(loudness < 0.01 * loudness.max()) > 0.1
    rises = np.diff((loudness > 0.2 * loudness.max()).astype(int)) == 1
    assert 20 < rises.sum() < 120


def test_a_shift_is_measured_exactly_and_is_unambiguous() -> None:
    """What a comparison at the other end needs: the sound is like itself at no other place."""
    whole = Speech(16_000).samples(0, 160_000)[:, 0].astype(float)
    piece = whole[70_000:86_000]
    matches = np.fft.irfft(np.fft.rfft(whole) * np.conj(np.fft.rfft(piece, 160_000)), 160_000)
    best = int(matches.argmax())
    assert best == 70_000
    far = np.delete(matches, np.arange(best - 400, best + 400))
    assert far.max() < 0.7 * matches[best]


def test_noise_is_even_and_its_seeds_differ() -> None:
    first, second = noise(1, 10_000), noise(2, 10_000)
    assert 0 <= first.min() < 0.01
    assert 0.99 < first.max() < 1
    assert abs(first.mean() - 0.5) < 0.02
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.05
    assert noise(1, 3).tolist() == first[:3].tolist()
