"""Speech-like sound computed from the sample's number alone: for robots without a microphone, and for tests.

Syllables of voiced harmonics under three formants, some with a hiss before them, with pauses between words.
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
_ATTACK_S, _HISS_S = 0.03, 0.05
# The first three formants in Hz of a, e, i, o, u (Peterson and Barney 1952, men, rounded).
_VOWELS = ((730, 1090, 2440), (530, 1840, 2480), (270, 2290, 3010), (570, 840, 2410), (300, 870, 2240))
_FORMANT_WIDTH_HZ = 90.0


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
    edges = [rate * PERIOD_S * number // _SYLLABLES for number in range(_SYLLABLES + 1)]
    sound = np.zeros(edges[-1], np.float32)
    for number in range(_SYLLABLES):
        vowel, pitch, glide, loud, hissing = map(float, noise(number, 5))
        if number % _PAUSE_EVERY == _PAUSE_EVERY - 1:
            continue
        part = sound[edges[number] : edges[number + 1]]
        part += _voice(len(part), rate, _VOWELS[int(vowel * len(_VOWELS))], 95 + 60 * pitch, 0.4 * glide - 0.2) * (
            0.5 + 0.5 * loud
        )
        if hissing > 0.5:
            begin = part[: int(_HISS_S * rate)]
            hiss = np.diff(noise(1000 + number, len(begin) + 1))  # the difference takes the low tones away
            begin += (hiss * np.hanning(len(begin)) * 0.3).astype(np.float32)
    loudest = float(np.abs(sound).max())
    period = np.asarray(sound * (_PEAK / loudest), np.int16)
    period.flags.writeable = False
    return period


def _voice(count: int, rate: int, formants: tuple[int, ...], pitch_hz: float, glide: float) -> NDArray[np.float32]:
    """Return a vowel that swells and fades, while its pitch rises by the factor 1 + ``glide``."""
    time = np.arange(count) / rate
    length = count / rate
    phase = 2 * np.pi * pitch_hz * (time + glide * time**2 / (2 * length))
    highest = min(_HIGHEST_HZ, 0.45 * rate) / (pitch_hz * (1 + max(0.0, glide)))
    voice = np.zeros(count)
    for harmonic in range(1, int(highest) + 1):
        voice += _loudness(harmonic * pitch_hz, formants) * np.sin(harmonic * phase)
    swell = np.clip(np.minimum(time, length - time) / _ATTACK_S, 0, 1)
    return np.asarray(voice * np.sin(swell * np.pi / 2) ** 2, np.float32)


def _loudness(frequency: float, formants: tuple[int, ...]) -> float:
    """Return how well the mouth transmits a frequency: resonances above a slope of 6 dB per octave."""
    resonance = sum(1 / (1 + ((frequency - formant) / _FORMANT_WIDTH_HZ) ** 2) for formant in formants)
    return float((0.05 + resonance) * 100 / frequency)
