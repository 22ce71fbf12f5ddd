"""The pictures of a film, in a file of their own: whatever was sent is decoded and encoded as H.264."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from pebble.media.jpeg import Pixels

MILLISECOND: Final = Fraction(1, 1000)
_KEYFRAME_INTERVAL: Final = 60  # pictures: how far a player jumps
_NOMINAL_FPS: Final = 15  # for the encoder; each picture has its own time
_OPTIONS: Final = {"crf": "23", "preset": "veryfast"}


class PictureTrack:
    """Pictures of any size and encoding as H.264 of one size, that of the first."""

    def __init__(self, av: Any, path: Path) -> None:
        from pebble.media.decode import VideoDecoder

        self.path = path
        self.count = self.left_out = self.scaled = 0
        self.last_ms = -1
        self.size = (0, 0)
        self._av, self._decoder = av, VideoDecoder()
        self._out: Any = None
        self._stream: Any = None

    def add(self, payload: bytes, at_ms: int) -> None:
        """Show a picture at ``at_ms``, but after the one before it."""
        decoded = self._decoder.feed(payload)
        if decoded is None:  # damaged, or without those that it builds on
            self.left_out += 1
            return
        if self._stream is None:
            self._open(*decoded.picture.shape[:2])
        frame = self._av.VideoFrame.from_ndarray(self._fitted(decoded.picture), format="bgr24")
        self.last_ms = frame.pts = max(at_ms, self.last_ms + 1)
        frame.time_base = MILLISECOND
        self.count += 1
        self._out.mux(self._stream.encode(frame))

    def close(self) -> None:
        if self._stream is not None:
            self._out.mux(self._stream.encode(None))
            self._out.close()

    def _open(self, height: int, width: int) -> None:
        """Colour is stored for two by two pixels."""
        self.size = width & ~1, height & ~1
        self._out = self._av.open(str(self.path), "w", format="matroska")
        stream = self._stream = self._out.add_stream("libx264", rate=_NOMINAL_FPS, options=_OPTIONS)
        stream.width, stream.height = self.size
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = MILLISECOND
        stream.codec_context.gop_size = _KEYFRAME_INTERVAL
        stream.codec_context.max_b_frames = 0

    def _fitted(self, picture: Pixels) -> Pixels:
        """The picture as large as fits into the film, in its middle, on black."""
        import cv2
        import numpy as np

        width, height = self.size
        if picture.shape[:2] == (height, width):
            return picture
        self.scaled += 1
        scale = min(height / picture.shape[0], width / picture.shape[1])
        high = max(1, min(height, round(picture.shape[0] * scale)))
        wide = max(1, min(width, round(picture.shape[1] * scale)))
        top, left = (height - high) // 2, (width - wide) // 2
        whole = np.zeros((height, width, 3), np.uint8)
        way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        whole[top : top + high, left : left + wide] = cv2.resize(picture, (wide, high), interpolation=way)
        return whole
