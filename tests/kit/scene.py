"""A reader of the counter in the synthetic scene's pictures."""

from binascii import crc_hqx

import numpy as np
from numpy.typing import NDArray

from pebble.extensions.media.scene import BAND, COLUMNS, DARK, LIGHT, ROWS, Picture

_MIDDLE = (DARK + LIGHT) / 2
_MARGIN = 20  # a cell nearer than this to the middle is neither dark nor light: the picture is damaged
_WITHIN = (0.3, 0.4, 0.5, 0.6, 0.7)  # where a reader samples, as shares of a cell
_SMALLEST_BAND = 2 * ROWS  # pixels; with less, or below 2 pixels per column, it cannot be read


def read_counter(picture: Picture) -> int | None:
    """Return the number of the frame, read from a picture of any size, in colour (h, w, 3) or grey (h, w).

    None if there is no counter, or it is damaged: one in 65,536 damaged ones is read as a wrong number.
    """
    height, width = picture.shape[:2]
    band = height // BAND
    if band < _SMALLEST_BAND or width < 2 * COLUMNS:
        return None
    rows, columns = _samples(band, ROWS) + height - band, _samples(width, COLUMNS)
    grid = picture[np.ix_(rows, columns)].astype(np.float32)
    grey = grid if grid.ndim == 2 else grid.mean(axis=2)
    cells = grey.reshape(ROWS, len(_WITHIN), COLUMNS, len(_WITHIN)).mean(axis=(1, 3)).ravel()
    return None if np.any(np.abs(cells - _MIDDLE) < _MARGIN) else _value(cells > _MIDDLE)


def _value(bits: NDArray[np.bool_]) -> int | None:
    raw = np.packbits(bits).tobytes()
    return int.from_bytes(raw[:3]) if crc_hqx(raw[:3], 0xFFFF) == int.from_bytes(raw[3:]) else None


def _samples(length: int, cells: int) -> NDArray[np.intp]:
    """Return where to sample ``cells`` cells on ``length`` pixels: some places in each, away from its edges."""
    return (np.add.outer(np.arange(cells), _WITHIN) * length / cells).astype(np.intp).ravel()
