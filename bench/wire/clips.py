"""Synthetic clips: natural textures, a panning or resting camera, sensor noise."""

from __future__ import annotations

import math
from typing import Final, cast

import cv2
import numpy as np

from pebble.media.jpeg import Pixels

WIDTH, HEIGHT, FPS = 640, 480, 15
SCENES: Final = ("panning", "quiet")
_WORLD_WIDTH: Final = 2400
_MARGIN: Final = 48  # pixels of the world around the window


def film(scene: str, count: int) -> list[Pixels]:
    """BGR, always the same: a figure crosses the picture and moves against the background."""
    random, pictures = np.random.default_rng(8), []
    world = _world(random)
    # as of a small sensor in daylight: a standard deviation of 2 in levels of 255
    noise = random.normal(0, 2.0, (HEIGHT + 64, WIDTH + 64, 3)).astype(np.float32)
    for number in range(count):
        view = _view(world, scene, number)
        x, y = round(40 + number * 3.7) % WIDTH, 300
        cv2.ellipse(view, (x, y), (22, 60), 0, 0, 360, (52, 60, 140), -1, cv2.LINE_AA)
        cv2.circle(view, (x, y - 74), 17, (120, 150, 190), -1, cv2.LINE_AA)
        down, right = (number * 29) % 64, (number * 47) % 64  # another part of the noise in each frame
        grain = noise[down : down + HEIGHT, right : right + WIDTH]
        pictures.append(np.clip(view + grain + 0.5, 0, 255).astype(np.uint8))
    return pictures


def _view(world: Pixels, scene: str, number: int) -> Pixels:
    """A window onto the world. While panning it also rotates and zooms, so that no block is merely shifted."""
    along, sway, lean, scale = 300.0, 0.0, 0.0, 1.0
    if scene == "panning":  # in pixels and degrees: a robot that turns at about 10 degrees per second
        along, sway = number * 7.3, 3.0 * math.sin(number / 4)
        lean, scale = 1.5 * math.sin(number / 9), 1 + 0.05 * math.sin(number / 21)
    span = _WORLD_WIDTH - WIDTH - 2 * _MARGIN
    left = _MARGIN + span - abs(along % (2 * span) - span)  # forth and back
    middle_x, middle_y = left + WIDTH / 2, HEIGHT / 2 + _MARGIN + sway
    turn = cv2.getRotationMatrix2D((middle_x, middle_y), lean, scale)
    turn[:, 2] += np.array((WIDTH / 2 - middle_x, HEIGHT / 2 - middle_y))
    return cast(Pixels, cv2.warpAffine(world, turn, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC))


def _world(random: np.random.Generator) -> Pixels:
    """Octaves of noise of decreasing strength, like the 1/f spectrum of landscapes, and some edges."""
    height, width = HEIGHT + 2 * _MARGIN, _WORLD_WIDTH
    world = np.zeros((height, width, 3), np.float32)
    for octave in range(8):
        cells = (2 + (height >> (8 - octave)), 2 + (width >> (8 - octave)))
        light = random.normal(0, 1, (*cells, 1)) + 0.15 * random.normal(0, 1, (*cells, 3))
        clouds = cv2.resize(light.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
        world += 48 * 0.66**octave * clouds
    world += np.linspace(165, 85, height, dtype=np.float32)[:, None, None]  # the sky is brighter than the ground
    view = np.clip(world, 0, 255).astype(np.uint8)
    for _ in range(40):  # houses, posts, doors
        x, y = int(random.integers(0, width)), int(random.integers(60, height - 60))
        w, h = int(random.integers(8, 120)), int(random.integers(20, 180))
        patch, colour = view[y : y + h, x : x + w], random.integers(30, 220, 3)
        patch[:] = (patch * 0.3 + colour * 0.7).astype(np.uint8)
    return view
