"""Pictures out of the pixel formats that cameras deliver."""

from __future__ import annotations

from typing import Any

import numpy as np

from pebble.errors import PayloadError
from pebble.transports.frame_info import FrameInfo

Bytes = np.ndarray[Any, np.dtype[np.uint8]]
PICTURE_FORMATS = ("bgr24", "nv12", "yuyv", "mjpeg")
_LARGEST = 1 << 14  # pixels per side


def picture(data: Bytes, info: FrameInfo, width: int | None = None) -> Bytes:
    """(height, width, 3), BGR. Raises PayloadError for what is no picture."""
    if info.format == "mjpeg":
        found = _jpeg(data, info, width)
    elif info.format in PICTURE_FORMATS:
        found = _raw(data, info)
    else:
        raise PayloadError(f'a frame of format "{info.format}" is no picture')
    return found if width is None or width == found.shape[1] else _resized(found, width)


def _raw(data: Bytes, info: FrameInfo) -> Bytes:
    if info.format == "bgr24":
        return _rows(data, info, info.height, 3 * info.width).reshape(info.height, info.width, 3)
    import cv2  # tens of MB that only readers of such cameras pay for

    if info.width % 2 or info.height % 2:
        raise PayloadError(f"{info.format} of {info.width}x{info.height}: sides must be even")
    if info.format == "nv12":
        rows = _rows(data, info, info.height * 3 // 2, info.width)
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(rows), cv2.COLOR_YUV2BGR_NV12))
    rows = _rows(data, info, info.height, 2 * info.width)
    pixels = np.ascontiguousarray(rows).reshape(info.height, info.width, 2)
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_YUV2BGR_YUYV))


def _rows(data: Bytes, info: FrameInfo, rows: int, row_bytes: int) -> Bytes:
    """The pixels without what may follow each row."""
    stride = info.stride or row_bytes
    fits = 0 < info.width <= _LARGEST and 0 < info.height <= _LARGEST and stride >= row_bytes
    if not fits or data.size < stride * (rows - 1) + row_bytes:
        size = f"{info.width}x{info.height}, stride {info.stride}"
        raise PayloadError(f"{data.size} bytes are no {info.format} of {size}")
    if stride == row_bytes:
        return data[: rows * row_bytes].reshape(rows, row_bytes)
    return np.lib.stride_tricks.as_strided(data, (rows, row_bytes), (stride, 1), writeable=data.flags.writeable)


def _jpeg(data: Bytes, info: FrameInfo, width: int | None) -> Bytes:
    """Decoded at 1/2, 1/4 or 1/8 where that is enough for ``width``: a fraction of the work."""
    import cv2

    scale = _scale(info.width, width)
    flags = {1: cv2.IMREAD_COLOR, 2: cv2.IMREAD_REDUCED_COLOR_2, 4: cv2.IMREAD_REDUCED_COLOR_4}
    try:
        found = cv2.imdecode(data, flags.get(scale, cv2.IMREAD_REDUCED_COLOR_8))
    except cv2.error:  # an empty or hopeless buffer
        found = None
    if found is None:
        raise PayloadError(f"{data.size} bytes are no JPEG")
    return np.asarray(found)


def _scale(has: int, wanted: int | None) -> int:
    if wanted is None or wanted <= 0:
        return 1
    return next((scale for scale in (8, 4, 2) if has // scale >= wanted), 1)


def _resized(found: Bytes, width: int) -> Bytes:
    import cv2

    height = max(1, round(found.shape[0] * width / found.shape[1]))
    how = cv2.INTER_AREA if width < found.shape[1] else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(found, (width, height), interpolation=how))
