"""Measures of how alike two pieces of sound are."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Samples = npt.NDArray[np.float64]


def envelope(samples: Samples, rate: int) -> Samples:
    """Return the loudness in steps of 20 ms, which Opus preserves, unlike the waveform."""
    step = rate // 50
    whole = samples[: len(samples) // step * step].reshape(-1, step)
    loudness: Samples = np.sqrt(np.mean(whole**2, axis=1))
    return loudness


def best_match(part: Samples, whole: Samples) -> float:
    """Return the highest normalised correlation (-1..1) of ``part`` with any stretch of ``whole`` of its length."""
    count = len(part)
    if count == 0 or count > len(whole):
        return 0.0
    centred = part - part.mean()
    size = 1 << (len(whole) + count - 1).bit_length()
    products = np.fft.irfft(np.fft.rfft(whole, size) * np.conj(np.fft.rfft(centred, size)), size)[
        : len(whole) - count + 1
    ]
    sums = np.concatenate(([0.0], np.cumsum(whole)))
    squares = np.concatenate(([0.0], np.cumsum(whole**2)))
    spread = (squares[count:] - squares[:-count]) - (sums[count:] - sums[:-count]) ** 2 / count
    scale = np.sqrt(np.maximum(spread, 0.0) * np.sum(centred**2))
    return float(np.max(np.divide(products, scale, out=np.zeros_like(products), where=scale > 1e-9)))
