"""The quality of a decoded picture: PSNR over all colours, and SSIM (Wang et al. 2004) as the mean of the channels."""

from __future__ import annotations

import math

import cv2
import numpy as np

from pebble.media.jpeg import Pixels

_WINDOW, _SIGMA = (11, 11), 1.5  # the paper's Gaussian window
_C1, _C2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2


def squared_error(one: Pixels, other: Pixels) -> float:
    """Mean over all pixels and channels, in levels squared."""
    return float(cv2.norm(one, other, cv2.NORM_L2SQR)) / one.size


def psnr(mean_squared_error: float) -> float:
    """In dB; infinite for identical pictures."""
    return math.inf if mean_squared_error == 0 else 10 * math.log10(255**2 / mean_squared_error)


def ssim(one: Pixels, other: Pixels) -> float:
    """1 for identical pictures. BGR, of one shape. (Borders are reflected; the paper leaves them out.)"""
    x, y = one.astype(np.float32), other.astype(np.float32)
    mean_x, mean_y = _smooth(x), _smooth(y)
    both, squares = mean_x * mean_y, mean_x * mean_x + mean_y * mean_y
    covariance = _smooth(x * y) - both
    variances = _smooth(x * x + y * y) - squares
    likeness = (2 * both + _C1) * (2 * covariance + _C2) / ((squares + _C1) * (variances + _C2))
    return float(likeness.mean())


def _smooth(values: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(values, _WINDOW, _SIGMA)
