"""A frame: its bytes, their metadata, and the picture decoded from them."""

from importlib import import_module
from typing import Any

import msgspec
import numpy as np

from pebble.errors import PayloadError, TransportError

Bytes = np.ndarray[Any, np.dtype[np.uint8]]
PICTURE_FORMATS = ("bgr24", "nv12", "yuyv", "mjpeg")
_LARGEST = 1 << 14  # pixels per side


class FrameInfo(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """Metadata of a frame, sent as MessagePack in its attachment. New fields go to the end and have defaults."""

    sequence: int = 0  # set by the writer: 1, 2, 3 … since it was opened
    writer: int = 0  # set by the writer: a random number, new each time it is opened
    captured_ns: int = 0  # CLOCK_MONOTONIC when the frame was complete at the device
    captured_ms: int = 0  # the same moment in milliseconds since the epoch
    format: str = ""  # bgr24 | nv12 | yuyv | mjpeg | s16le
    width: int = 0  # pixels
    height: int = 0
    stride: int = 0  # bytes per row; 0 for mjpeg, and where rows follow each other without a gap
    rate: int = 0  # sound: samples per second and channel
    channels: int = 0  # interleaved


encode = msgspec.msgpack.Encoder().encode
_decode = msgspec.msgpack.Decoder(FrameInfo).decode


def decode(attachment: bytes) -> FrameInfo | None:
    """Return the metadata in ``attachment``; None if it is not a FrameInfo."""
    try:
        return _decode(attachment)
    except (msgspec.DecodeError, UnicodeDecodeError):
        return None


class Frame:
    """The bytes of one frame and its metadata.

    Without views the bytes are a copy for the caller. With views they are read-only and still belong to the writer:
    process them soon, and check `valid` afterwards. Arrays taken from a frame stay readable after its release.
    """

    __slots__ = ("_buffer", "_data", "info", "shared")

    def __init__(self, info: FrameInfo, data: Bytes, *, shared: bool, buffer: Any = None) -> None:
        self.info = info
        self.shared = shared  # received through shared memory, even if it was copied afterwards
        self._data: Bytes | None = data
        self._buffer = buffer  # the ZShm that ``data`` is a view of; None: ``data`` is a copy

    @property
    def data(self) -> Bytes:
        """The bytes, one-dimensional. Raises TransportError after `release`."""
        if self._data is None:
            raise TransportError("this frame has been released")
        return self._data

    def picture(self, width: int | None = None) -> Bytes:
        """Return the picture of the frame: (height, width, 3), BGR, scaled to ``width`` pixels if given.

        A `bgr24` frame in its original size is not copied: with views the result is a view, too. Raises PayloadError if
        the frame is no picture.
        """
        return picture(self.data, self.info, width)

    def valid(self) -> bool:
        """True if the memory still holds this frame. If not, discard what was read: it may be wrong."""
        if self._data is None:
            return False
        return self._buffer is None or bool(self._buffer.is_valid())

    def release(self) -> None:
        """Give the memory back to the writer, once no array of it is left. Deleting the frame does the same."""
        self._data = self._buffer = None


def picture(data: Bytes, info: FrameInfo, width: int | None = None) -> Bytes:
    """Return the picture in ``data``: (height, width, 3), BGR. Raises PayloadError if it is no picture."""
    if info.format == "mjpeg":
        pixels = _jpeg(data, info, width)
    elif info.format in PICTURE_FORMATS:
        pixels = _raw(data, info)
    else:
        raise PayloadError(f'a frame of format "{info.format}" is no picture')
    return pixels if width is None or width == pixels.shape[1] else _resized(pixels, width)


def _raw(data: Bytes, info: FrameInfo) -> Bytes:
    """Return the picture of a frame that is not compressed: ``bgr24``, ``nv12`` or ``yuyv``."""
    if info.format == "bgr24":
        return _rows(data, info, info.height, 3 * info.width).reshape(info.height, info.width, 3)
    cv2 = _opencv(f"a frame of format {info.format}")
    if info.width % 2 or info.height % 2:
        raise PayloadError(f"{info.format} of {info.width}x{info.height}: sides must be even")
    if info.format == "nv12":  # a plane of brightness, then one of colour, half as high
        rows = _rows(data, info, info.height * 3 // 2, info.width)
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(rows), cv2.COLOR_YUV2BGR_NV12))
    rows = _rows(data, info, info.height, 2 * info.width)
    pixels = np.ascontiguousarray(rows).reshape(info.height, info.width, 2)
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_YUV2BGR_YUYV))


def _opencv(what: str) -> Any:
    """Return the module cv2: tens of MB, only for readers that need it. Raises PayloadError if it is missing."""
    try:
        return import_module("cv2")
    except ModuleNotFoundError:
        raise PayloadError(f'{what} needs OpenCV: pip install "pebble-robot[media]"') from None


def _rows(data: Bytes, info: FrameInfo, rows: int, row_bytes: int) -> Bytes:
    """Return the rows of pixels without the padding at their ends."""
    stride = info.stride or row_bytes
    fits = 0 < info.width <= _LARGEST and 0 < info.height <= _LARGEST and stride >= row_bytes
    if not fits or data.size < stride * (rows - 1) + row_bytes:
        size = f"{info.width}x{info.height}, stride {info.stride}"
        raise PayloadError(f"{data.size} bytes are no {info.format} of {size}")
    if stride == row_bytes:
        return data[: rows * row_bytes].reshape(rows, row_bytes)
    return np.lib.stride_tricks.as_strided(data, (rows, row_bytes), (stride, 1), writeable=data.flags.writeable)


def _jpeg(data: Bytes, info: FrameInfo, width: int | None) -> Bytes:
    """Return the decoded JPEG, at 1/2, 1/4 or 1/8 size if that is enough for ``width``: much less work."""
    cv2 = _opencv(f"a frame of format {info.format}")
    scale = _scale(info.width, width)
    reduced = {2: cv2.IMREAD_REDUCED_COLOR_2, 4: cv2.IMREAD_REDUCED_COLOR_4, 8: cv2.IMREAD_REDUCED_COLOR_8}
    try:
        pixels = cv2.imdecode(data, reduced.get(scale, cv2.IMREAD_COLOR))
    except cv2.error:  # an empty or undecodable buffer
        pixels = None
    if pixels is None:
        raise PayloadError(f"{data.size} bytes are no JPEG")
    return np.asarray(pixels)


def _scale(width: int, wanted: int | None) -> int:
    """Return the most (8, 4, 2 or 1) by which ``width`` can be divided without falling below ``wanted``."""
    for scale in (8, 4, 2):
        if wanted is not None and 0 < wanted <= width // scale:
            return scale
    return 1


def _resized(pixels: Bytes, width: int) -> Bytes:
    cv2 = _opencv("a picture of another size")
    old_height, old_width = pixels.shape[:2]
    height = max(1, round(old_height * width / old_width))
    interpolation = cv2.INTER_AREA if width < old_width else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(pixels, (width, height), interpolation=interpolation))
