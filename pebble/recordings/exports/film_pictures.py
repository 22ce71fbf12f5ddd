"""The pictures of a film: whatever was sent is decoded and encoded as H.264."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from fractions import Fraction
from typing import Any, Final

LAST_PICTURE_MS: Final = 66  # how long the last picture of a film is shown
_MILLISECOND: Final = Fraction(1, 1000)
_KEYFRAME_INTERVAL: Final = 60  # pictures: how far a player jumps
_NOMINAL_FPS: Final = 15  # for the encoder; each picture has its own time
_OPTIONS: Final = {"crf": "23", "preset": "veryfast"}


class PictureTrack:
    """Pictures of any size and encoding as H.264 of one size, that of the first: the encoder scales the others."""

    def __init__(self, av: Any, out: Any) -> None:
        from pebble.media.decode import VideoDecoder

        self.count = self.left_out = 0
        self.last_ms = -1
        self._av, self._out, self._decoder = av, out, VideoDecoder()

    def packets(self, pictures: Iterable[tuple[int, bytes]]) -> Iterator[Any]:
        """Yield packets of a stream of ``out``: each picture is shown at its time (ms), but after the one before it."""
        stream: Any = None
        for at_ms, payload in pictures:
            decoded = self._decoder.feed(payload)
            if decoded is None:  # damaged, or without those that it builds on
                self.left_out += 1
                continue
            if stream is None:
                stream = self._opened(*decoded.picture.shape[:2])
            frame = self._av.VideoFrame.from_ndarray(decoded.picture, format="bgr24")
            self.last_ms = frame.pts = max(at_ms, self.last_ms + 1)
            frame.time_base = _MILLISECOND
            self.count += 1
            yield from _lasting(stream.encode(frame))
        if stream is not None:
            yield from _lasting(stream.encode(None))

    def _opened(self, height: int, width: int) -> Any:
        """Colour is stored for two by two pixels."""
        stream = self._out.add_stream("libx264", rate=_NOMINAL_FPS, options=_OPTIONS)
        stream.width, stream.height = width & ~1, height & ~1
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = _MILLISECOND
        stream.codec_context.gop_size = _KEYFRAME_INTERVAL
        stream.codec_context.max_b_frames = 0
        return stream


def _lasting(packets: list[Any]) -> list[Any]:
    """Give each a length, which counts for the last one: the others are shown until the next."""
    for packet in packets:
        packet.duration = LAST_PICTURE_MS
    return packets
