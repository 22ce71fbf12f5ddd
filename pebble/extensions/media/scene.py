"""A moving scene computed from the frame's number alone: for robots without a camera, tests and measurements.

The scene shows its number in a form that can be read back after lossy encoding and resizing.
"""

from binascii import crc_hqx
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

Picture: TypeAlias = NDArray[np.uint8]

_STEP = np.uint64(0x9E3779B97F4A7C15)  # of noise()

COUNTER_LIMIT: Final = 1 << 24  # the counter starts again at 0: after 13 days at 15 frames per second
TAG_ID: Final = 7

# The inner bits of tag 7 of the family 36h11, 1 is white; a black border of one cell belongs around them.
_TAG_BITS = ("001010", "111000", "011101", "001010", "011000", "001000")
_TAG_CELLS = 10  # 6 of bits, 2 of black border, 2 of quiet zone

ROWS, COLUMNS = 2, 20  # of the counter's cells: 24 bits of number, 16 of checksum
BAND = 10  # the counter takes the lowest tenth of the picture
# The swing stays below 128: encoders that send differences clip them there, and the counter changes in every frame.
DARK, LIGHT = 72, 184

_TURN = 320  # frames until the background has passed once
_LAP = 450  # frames of one round of the tag
_BOUNCE_X, _BOUNCE_Y = 211, 89  # frames of one swing of the ball: its path repeats only after 18,779 frames
_STRIPE = 16  # rows of the background that are made at a time
_BALL_BGR = np.array((60, 90, 220), np.uint8)


def noise(seed: int, count: int) -> NDArray[np.float32]:
    """Return ``count`` pseudo-random numbers, 0 to 1, the same on every machine; ``seed``: 32 bits.

    Splitmix64 (Steele, Lea, Flood 2014), which needs no import of numpy.random.
    """
    state = (np.arange(1, count + 1, dtype=np.uint64) + np.uint64(seed << 32)) * _STEP
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return ((state ^ (state >> np.uint64(31))) >> np.uint64(40)).astype(np.float32) / np.float32(1 << 24)


class Scene:
    """A scene that draws any of its frames into an array of the caller. A number always gives the same pixels."""

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height = width, height
        self._floor = height - height // BAND  # the counter begins here, everything else ends here
        self._background = _landscape(width, self._floor)
        self._tag = _tag(max(1, self._floor // (3 * _TAG_CELLS)))
        self._ball = _disc(max(1, self._floor // 12))
        self._cell = np.arange(width).repeat(3) * COLUMNS // width  # of the counter, for each byte of a row of pixels

    def render(self, number: int, out: Picture) -> None:
        """Draw frame ``number`` into ``out``, of shape (height, width, 3), BGR."""
        self._draw_background(number, out)
        self._draw_ball(number, out)
        self._draw_tag(number, out)
        self._draw_counter(number % COUNTER_LIMIT, out)

    def _draw_background(self, number: int, out: Picture) -> None:
        shift = number % _TURN * self.width // _TURN
        split = self.width - shift
        out[: self._floor, :split] = self._background[:, shift:]
        out[: self._floor, split:] = self._background[:, :shift]

    def _draw_ball(self, number: int, out: Picture) -> None:
        size = self._ball.shape[0]
        left = _swing(number, _BOUNCE_X, self.width - size)
        top = _swing(number, _BOUNCE_Y, self._floor - size)
        under = out[top : top + size, left : left + size]
        np.copyto(under, _BALL_BGR, where=self._ball[: under.shape[0], : under.shape[1], None])

    def _draw_tag(self, number: int, out: Picture) -> None:
        left, top = self._tag_corner(number)
        under = out[top : min(top + self._tag.shape[0], self._floor), left : left + self._tag.shape[1]]
        under[:] = self._tag[: under.shape[0], : under.shape[1], None]

    def _tag_corner(self, number: int) -> tuple[int, int]:
        angle = 2 * np.pi * (number % _LAP) / _LAP
        size = self._tag.shape[0]
        left = (self.width - size) * (0.5 + 0.45 * np.cos(angle))
        top = (self._floor - size) * (0.5 + 0.45 * np.sin(angle))
        return max(0, int(left)), max(0, int(top))

    def _draw_counter(self, value: int, out: Picture) -> None:
        lines = np.where(_bits(value), np.uint8(LIGHT), np.uint8(DARK))[:, self._cell]
        for row, line in enumerate(lines):
            top, bottom = (self._floor + (self.height - self._floor) * edge // ROWS for edge in (row, row + 1))
            out[top:bottom] = line.reshape(1, self.width, 3)


def _bits(value: int) -> NDArray[np.bool_]:
    """Return the counter's cells: the bits of ``value``, then those of its checksum."""
    raw = value.to_bytes(3)
    checked = raw + crc_hqx(raw, 0xFFFF).to_bytes(2)
    return np.unpackbits(np.frombuffer(checked, np.uint8)).astype(bool).reshape(ROWS, COLUMNS)


def _swing(number: int, period: int, room: int) -> int:
    """Return a position that moves to and fro between 0 and ``room``."""
    phase = number % period / period
    return int(max(0, room) * abs(2 * phase - 1))


def _landscape(width: int, height: int) -> Picture:
    """Return a texture with detail of all sizes, as in nature; its right edge continues at its left edge."""
    light = _grids(0, octaves=6, contrast=100)
    tints = [_grids(100 * channel, octaves=2, contrast=40) for channel in (1, 2, 3)]  # seeds that are far apart
    picture = np.empty((height, width, 3), np.uint8)
    for top in range(0, height, _STRIPE):  # whole planes of floats would need many times the picture's memory
        rows = np.arange(top, min(top + _STRIPE, height), dtype=np.float32) / np.float32(height)
        grey = _texture(light, rows, width) + np.float32(118)  # the mean: that of a texture is 0
        for channel, tint in enumerate(tints):
            stripe = np.asarray(grey + _texture(tint, rows, width), np.float32)
            picture[top : top + _STRIPE, :, channel] = np.clip(stripe, np.float32(0), np.float32(255))
    return picture


def _grids(seed: int, *, octaves: int, contrast: float) -> list[NDArray[np.float32]]:
    """Return grids of random numbers, from coarse and strong to fine and weak."""
    shapes = [((3 << octave) + 1, 4 << octave) for octave in range(octaves)]
    return [
        (noise(seed + octave, rows * columns).reshape(rows, columns) - 0.5) * np.float32(contrast / 1.6**octave)
        for octave, (rows, columns) in enumerate(shapes)
    ]


def _texture(grids: list[NDArray[np.float32]], rows: NDArray[np.float32], width: int) -> NDArray[np.float32]:
    """Return the sum of the grids, each stretched over the picture, for ``rows`` from 0 (top) to 1."""
    return np.asarray(sum(_stretched(grid, rows, width) for grid in grids), np.float32)


def _stretched(grid: NDArray[np.float32], rows: NDArray[np.float32], width: int) -> NDArray[np.float32]:
    """Return the grid's values at ``rows`` (0 to 1), linear between its points; the right edge meets the left one."""
    x = np.arange(width, dtype=np.float32) * grid.shape[1] / width
    y = rows * (grid.shape[0] - 1)
    left, top = x.astype(np.intp), y.astype(np.intp)
    across, down = x - left, (y - top)[:, None]
    lines = grid[top] * (1 - down) + grid[top + 1] * down
    return np.asarray(lines[:, left] * (1 - across) + lines[:, (left + 1) % grid.shape[1]] * across)


def _tag(cell: int) -> Picture:
    """Return the AprilTag with its white border, ``cell`` pixels per cell."""
    cells = np.full((_TAG_CELLS, _TAG_CELLS), 215, np.uint8)
    cells[1:-1, 1:-1] = 40
    cells[2:-2, 2:-2] = [[215 if bit == "1" else 40 for bit in row] for row in _TAG_BITS]
    return cells.repeat(cell, axis=0).repeat(cell, axis=1)


def _disc(size: int) -> NDArray[np.bool_]:
    offset = np.arange(size) - (size - 1) / 2
    return offset[:, None] ** 2 + offset**2 <= (size / 2) ** 2
