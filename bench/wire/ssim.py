"""The quality of a decoded picture."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np

from pebble.media.jpeg import Pixels


def ssim(one: Pixels, other: Pixels) -> float:
    """SSIM (Wang et al. 2004), the mean of the channels: 1 for identical pictures. BGR, of one shape.

    Borders are reflected; the paper leaves them out.
    """
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    smooth = partial(cv2.GaussianBlur, ksize=(11, 11), sigmaX=1.5)  # the paper's window
    x, y = one.astype(np.float32), other.astype(np.float32)
    mean_x, mean_y = smooth(x), smooth(y)
    both, squares = mean_x * mean_y, mean_x * mean_x + mean_y * mean_y
    covariance, variances = smooth(x * y) - both, smooth(x * x + y * y) - squares
    likeness = (2 * both + c1) * (2 * covariance + c2) / ((squares + c1) * (variances + c2))
    return float(likeness.mean())
