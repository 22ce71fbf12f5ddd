"""Conversions of samples in arrays: their rate, format and number of channels. Pure."""

from math import ceil, gcd
from typing import Any

import numpy as np
import numpy.typing as npt

Samples = npt.NDArray[np.int16]  # (samples, channels)

_CROSSINGS = 16  # zero crossings of the filter to each side: alias and image are below -60 dB
_PASS = 0.92  # of the lower of the two Nyquist frequencies
_PHASES = 512  # at most; rates whose ratio needs more are met to 1/512 of a sample


def to_samples(pcm: bytes, channels: int) -> Samples:
    """Return interleaved s16le as an array (samples, channels). An unfinished last sample is left out."""
    whole = len(pcm) // (2 * channels) * channels
    return np.frombuffer(pcm, "<i2", whole).reshape(-1, channels)


def to_bytes(samples: Samples) -> bytes:
    """Return an array of samples as interleaved s16le."""
    return samples.astype("<i2", copy=False).tobytes()


def remix(samples: Samples, channels: int) -> Samples:
    """Return the samples with another number of channels, each the mean of all: enough for a robot."""
    if samples.shape[1] == channels:
        return samples
    mean = samples.mean(axis=1, dtype=np.float32)
    return np.repeat(np.rint(mean).astype(np.int16)[:, None], channels, axis=1)


def to_int16(samples: npt.NDArray[np.floating[Any]]) -> Samples:
    """Return the samples rounded to s16; values out of range are clipped."""
    clipped: Samples = np.rint(np.clip(samples, -32768, 32767)).astype(np.int16)
    return clipped


class Resampler:
    """A converter of one stream to another rate by a windowed sinc, without seams; delays by about 1 ms.

    Chunks that hold a whole number of output samples yield exactly that many.
    """

    def __init__(self, rate: int, rate_out: int, channels: int) -> None:
        """Compute the filter. ``_up`` output samples take as long as ``_down`` input samples."""
        common = gcd(rate, rate_out)
        self._up, self._down = rate_out // common, rate // common
        widened = max(1.0, self._down / self._up)  # a lower rate passes less, which takes a longer filter
        self._taps = 2 * ceil(_CROSSINGS * widened)
        self._filter = _filter(min(self._up, _PHASES), self._taps, _PASS / widened)
        self._tail = np.zeros((self._taps - 1, channels), np.float32)
        self._at = 0  # position of the next output sample, from the beginning of the tail; unit: an input sample / _up

    def feed(self, samples: Samples) -> Samples:
        """Return the next samples at the other rate."""
        if self._up == self._down:
            return samples
        fed = np.concatenate((self._tail, samples.astype(np.float32)))
        windows = len(fed) - self._taps + 1  # positions of the filter in ``fed``, one input sample apart
        count = max(0, ceil((windows * self._up - self._at) / self._down))
        # In units of 1/_up input sample: the whole input samples choose the window, the rest the phase of the filter.
        positions = self._at + self._down * np.arange(count, dtype=np.int64)
        phases = positions % self._up * len(self._filter) // self._up
        views = np.lib.stride_tricks.sliding_window_view(fed, self._taps, axis=0)[positions // self._up]
        mixed = np.einsum("nck,nk->nc", views, self._filter[phases], optimize=False)
        self._at += self._down * count - windows * self._up  # now from the beginning of the new tail
        self._tail = fed[windows:]
        return to_int16(mixed)


def _filter(phases: int, taps: int, passed: float) -> npt.NDArray[np.float32]:
    """Return the low pass, (phases, taps), for each position between two samples; each row sums up to 1."""
    offsets = np.arange(taps) - (taps / 2 - 1) - np.arange(phases)[:, None] / phases
    shape = np.sinc(offsets * passed) * np.cos(np.pi * np.clip(offsets / taps, -0.5, 0.5)) ** 2
    normal: npt.NDArray[np.float32] = (shape / shape.sum(axis=1, keepdims=True)).astype(np.float32)
    return normal
