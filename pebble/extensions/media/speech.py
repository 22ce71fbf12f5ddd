"""Speech-like sound computed from the sample's number alone: for robots without a microphone, and for tests.

Syllables of a gliding voice, with pauses between words.
"""

from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pebble.extensions.media.scene import noise

PERIOD_S: Final = 10  # then it repeats: the longest delay that a comparison can measure

_SYLLABLES = 50  # in one period: 200 ms each, as people speak
_PAUSE_EVERY = 6  # syllables
_PEAK = 12_000  # of 32,767
_HIGHEST_HZ = 4_000  # of the harmonics


class Speech:
    """A source of samples of any rate in Hz, equal on all channels. A number gives the same sample everywhere."""

    def __init__(self, rate: int, channels: int = 1) -> None:
        self.rate, self.channels = rate, channels
        self._mono = _period(rate)

    def samples(self, first: int, count: int) -> NDArray[np.int16]:
        """Return ``count`` samples from number ``first`` on, of shape (count, channels)."""
        mono = self._mono.take(np.arange(first, first + count), mode="wrap")
        return np.repeat(mono[:, None], self.channels, axis=1)


@lru_cache(maxsize=4)  # it takes a tenth of a second
def _period(rate: int) -> NDArray[np.int16]:
    """Return all samples until the sound repeats."""
    edges = [rate * PERIOD_S * number // _SYLLABLES for number in range(_SYLLABLES + 1)]
    sound = np.zeros(edges[-1], np.float32)
    for number in range(_SYLLABLES):
        pitch, glide, loud = map(float, noise(number, 3))
        if number % _PAUSE_EVERY < _PAUSE_EVERY - 1:
            part = sound[edges[number] : edges[number + 1]]
            part += (0.5 + 0.5 * loud) * _syllable(len(part), rate, 95 + 60 * pitch, 0.4 * glide - 0.2)
    period = np.asarray(sound * (_PEAK / float(np.abs(sound).max())), np.int16)
    period.flags.writeable = False
    return period


def _syllable(count: int, rate: int, pitch_hz: float, glide: float) -> NDArray[np.float32]:
    """Return harmonics that swell and fade; their pitch rises by ``glide`` × itself until the end."""
    time = np.arange(count) / rate
    phase = 2 * np.pi * pitch_hz * (time + glide * time**2 / (2 * time[-1]))
    highest = min(_HIGHEST_HZ, 0.45 * rate) / (pitch_hz * (1 + max(0.0, glide)))
    harmonics = (np.sin(number * phase) / number for number in range(1, int(highest) + 1))
    return np.asarray(sum(harmonics) * np.hanning(count), np.float32)
