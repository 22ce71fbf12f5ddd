"""Deterministic video clips to measure encoders: natural textures, a panning or resting camera, sensor noise."""

from __future__ import annotations

import math
from typing import Final, cast

import cv2
import numpy as np

from pebble.media.jpeg import Pixels

WIDTH, HEIGHT, FPS = 640, 480, 15
SCENES: Final = ("panning", "quiet")

_SEED: Final = 8
_WORLD_WIDTH: Final = 2400
_PAN: Final = 7.3  # pixels per frame: a robot that turns at about 10 degrees per second
_SWAY: Final = 3.0  # pixels up and down while it drives
_LEAN: Final = 1.5  # degrees to either side
_MARGIN: Final = 48  # pixels of the world around the window
_NOISE: Final = 2.0  # standard deviation of a small sensor's noise in daylight, in levels of 255


class Clip:
    """``frame(n)`` depends on n only."""

    def __init__(self, scene: str) -> None:
        self.scene = scene
        random = np.random.default_rng(_SEED)
        self._world = _world(random)
        noise = random.normal(0, _NOISE, (HEIGHT + 64, WIDTH + 64, 3))
        self._noise = noise.astype(np.float32)

    def frame(self, number: int) -> Pixels:
        """BGR, 640×480: a figure crosses the picture and moves against the background."""
        view = self._view(number)
        x, y = round(40 + number * 3.7) % WIDTH, 300
        cv2.ellipse(view, (x, y), (22, 60), 0, 0, 360, (52, 60, 140), -1, cv2.LINE_AA)
        cv2.circle(view, (x, y - 74), 17, (120, 150, 190), -1, cv2.LINE_AA)
        down, right = (number * 29) % 64, (number * 47) % 64  # another part of the noise in each frame
        grain = self._noise[down : down + HEIGHT, right : right + WIDTH]
        return cast(Pixels, np.clip(view + grain + 0.5, 0, 255).astype(np.uint8))

    def _view(self, number: int) -> Pixels:
        """A window onto the world. While panning it also rotates and zooms, so that no block is merely shifted."""
        if self.scene == "quiet":
            along, sway, lean, scale = 300.0, 0.0, 0.0, 1.0
        else:
            along, sway = number * _PAN, _SWAY * math.sin(number / 4)
            lean, scale = _LEAN * math.sin(number / 9), 1 + 0.05 * math.sin(number / 21)
        span = _WORLD_WIDTH - WIDTH - 2 * _MARGIN
        left = _MARGIN + span - abs(along % (2 * span) - span)  # forth and back
        middle_x, middle_y = left + WIDTH / 2, HEIGHT / 2 + _MARGIN + sway
        turn = cv2.getRotationMatrix2D((middle_x, middle_y), lean, scale)
        turn[:, 2] += np.array((WIDTH / 2 - middle_x, HEIGHT / 2 - middle_y))
        return cast(Pixels, cv2.warpAffine(self._world, turn, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC))


def _world(random: np.random.Generator) -> Pixels:
    """Octaves of noise of decreasing strength, like the 1/f spectrum of landscapes, and some edges."""
    shape = (HEIGHT + 2 * _MARGIN, _WORLD_WIDTH, 3)
    world = np.zeros(shape, np.float32)
    for octave in range(8):
        cells = (2 + (shape[0] >> (8 - octave)), 2 + (shape[1] >> (8 - octave)))
        light = random.normal(0, 1, (*cells, 1)) + 0.15 * random.normal(0, 1, (*cells, 3))
        size = (shape[1], shape[0])
        world += 48 * 0.66**octave * cv2.resize(light.astype(np.float32), size, interpolation=cv2.INTER_CUBIC)
    world += np.linspace(165, 85, shape[0], dtype=np.float32)[:, None, None]  # the sky is brighter than the ground
    view = np.clip(world, 0, 255).astype(np.uint8)
    for _ in range(40):  # houses, posts, doors
        x, y = int(random.integers(0, shape[1])), int(random.integers(60, shape[0] - 60))
        w, h = int(random.integers(8, 120)), int(random.integers(20, 180))
        colour = [int(part) for part in random.integers(30, 220, 3)]
        patch = view[y : y + h, x : x + w]
        patch[:] = (patch * 0.3 + np.array(colour) * 0.7).astype(np.uint8)
    return view
