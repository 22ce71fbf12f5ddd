"""Numbers that look random and are the same on every machine, without the library that numpy has for it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_STEP = np.uint64(0x9E3779B97F4A7C15)


def noise(seed: int, count: int) -> NDArray[np.float32]:
    """``count`` numbers, 0 to 1; another ``seed`` of up to 32 bits, others. Splitmix64 (Steele, Lea, Flood 2014)."""
    state = (np.arange(1, count + 1, dtype=np.uint64) + np.uint64(seed << 32)) * _STEP
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return ((state ^ (state >> np.uint64(31))) >> np.uint64(40)).astype(np.float32) / np.float32(1 << 24)
