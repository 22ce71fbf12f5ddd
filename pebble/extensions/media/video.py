"""Video encoders by name: they make an MQTT payload of each picture."""

from typing import Final

from pebble.contract.encodings import ALL_VIDEO
from pebble.errors import ConfigError
from pebble.extensions.media import json_video, pyav
from pebble.extensions.media.h264 import H264Encoder
from pebble.extensions.media.jpeg import Pixels
from pebble.extensions.media.jpeg_delta import JpegDelta
from pebble.extensions.media.packets import KEY_FRAME, SEQUENCE_LIMIT, Picture, PictureKind

#: The encodings that this installation can make.
VIDEO_ENCODINGS: Final = pyav.available(ALL_VIDEO)

DEFAULT_QUALITY: Final = 10
_H264_INTERVAL_S: Final = 4.0  # a receiver that misses a frame requests a key frame; this is for receivers that cannot


class VideoEncoder:
    """An encoder of one stream; its frames are numbered from 0."""

    def __init__(self, name: str, codec: H264Encoder | JpegDelta, quality: float) -> None:
        """Store the arguments. ``quality``, 1..100 as of a JPEG, may be changed later."""
        self.name, self.quality = name, quality
        self.last_was_keyframe = False
        self._codec, self._frame = codec, 0

    def encode(self, picture: Pixels, captured_ms: int, *, keyframe: bool = False) -> bytes:
        """Return the MQTT payload of ``picture``; with ``keyframe`` a full picture.

        ``picture``: BGR, uint8, (height, width, 3); it is not changed.
        """
        body = self._codec.encode(picture, self.quality, keyframe=keyframe)
        self.last_was_keyframe = full = self._codec.keyframe
        frame, self._frame = self._frame, (self._frame + 1) % SEQUENCE_LIMIT
        if self.name == "json":
            return json_video.pack(frame, full, captured_ms, body)
        captured_ms = max(0, captured_ms)  # no header has times before 1970: a clock that is not set counts as unknown
        if self.name == "h264":
            return Picture(PictureKind.H264, frame, captured_ms, body, KEY_FRAME if full else 0).pack()
        return Picture(PictureKind.JPEG if full else PictureKind.DELTA_JPEG, frame, captured_ms, body).pack()


def make_encoder(
    name: str,
    *,
    fps: float,
    keyframe_interval: int | None = None,
    quality: float = DEFAULT_QUALITY,
) -> VideoEncoder:
    """Return the encoder called ``name``: json, pbvd or h264.

    ``keyframe_interval``: pictures from one key frame to the next. None: the pictures of a third of a second (the
    paper's rule), for h264 of four seconds. Raises ConfigError for an unknown name, and PebbleError that says what to
    install.
    """
    if keyframe_interval is None:
        keyframe_interval = round(fps * _H264_INTERVAL_S) if name == "h264" else int(fps / 3)
    interval = max(1, keyframe_interval)
    if name not in ALL_VIDEO:
        raise ConfigError(f"video encoding {name!r}: unknown; there are {', '.join(ALL_VIDEO)}")
    codec = H264Encoder(fps, interval) if name == "h264" else JpegDelta(interval)
    return VideoEncoder(name, codec, quality)
