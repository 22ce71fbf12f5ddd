"""Speech-like sound computed from the sample's number alone: for robots without a microphone, and for tests."""

from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pebble.media.scene import noise

PERIOD_S: Final = 10  # then it repeats: the longest delay that a comparison can measure

_SYLLABLES = 50  # in one period: 200 ms each, as people speak
_PAUSE_EVERY = 6  # syllables
_PEAK = 12_000  # of 32,767


class Speech:
    """Samples of any rate in Hz, and the same on every channel. The same number gives the same sample, everywhere."""

    def __init__(self, rate: int, channels: int = 1) -> None:
        self.rate, self.channels = rate, channels
        self._mono = _period(rate)

    def samples(self, first: int, count: int) -> NDArray[np.int16]:
        """Return ``count`` samples from number ``first`` on, of shape (count, channels)."""
        mono = self._mono.take(np.arange(first, first + count), mode="wrap")
        return np.repeat(mono[:, None], self.channels, axis=1)


@lru_cache(maxsize=4)
def _period(rate: int) -> NDArray[np.int16]:
    """Return syllables that rise from a low tone to a higher one, no two alike, with pauses between words."""
    edges = [rate * PERIOD_S * number // _SYLLABLES for number in range(_SYLLABLES + 1)]
    period = np.zeros(edges[-1], np.int16)
    for number in range(_SYLLABLES):
        if number % _PAUSE_EVERY == _PAUSE_EVERY - 1:
            continue
        low, high, loud = map(float, noise(number, 3))
        count = edges[number + 1] - edges[number]
        time, length = np.arange(count) / rate, count / rate
        first_hz, last_hz = 150 + 250 * low, 600 + 1000 * high
        phase = 2 * np.pi * (first_hz * time + (last_hz - first_hz) * time**2 / (2 * length))
        swell = np.sin(np.pi * time / length)
        period[edges[number] : edges[number + 1]] = _PEAK * (0.5 + 0.5 * loud) * swell * np.sin(phase)
    period.flags.writeable = False
    return period
