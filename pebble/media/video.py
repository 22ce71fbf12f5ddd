"""Video encoders by name: a picture in, one MQTT payload out."""

from abc import ABC, abstractmethod
from typing import Final, Protocol

from pebble.contract.encodings import ALL_VIDEO
from pebble.contract.packets import KEY_FRAME, SEQUENCE_LIMIT, Picture, PictureKind
from pebble.errors import ConfigError
from pebble.media import pyav
from pebble.media.h264 import H264Encoder
from pebble.media.jpeg import Pixels
from pebble.media.jpeg_delta import JpegDelta
from pebble.media.json_video import JsonPicture

#: Those this installation can make.
VIDEO_ENCODINGS: Final = pyav.available(ALL_VIDEO)

DEFAULT_QUALITY: Final = 10
_H264_INTERVAL_S: Final = 4.0  # a receiver that misses a frame requests a key frame; this is for receivers that cannot


class VideoEncoder(Protocol):
    """One stream to one topic; frames are numbered from 0, by one."""

    name: str
    quality: float  # 1..100, as of a JPEG; may be set at any time
    bitrate: int | None  # bits per second, of h264 only; may be set at any time, None: constant quality
    last_was_keyframe: bool

    def encode(self, picture: Pixels, captured_ms: int, *, keyframe: bool = False) -> bytes:
        """``picture``: BGR, uint8, (height, width, 3), only read. ``keyframe``: make this one a full picture."""
        ...


def make_encoder(
    name: str,
    *,
    fps: float,
    keyframe_interval: int | None = None,
    quality: float = DEFAULT_QUALITY,
    bitrate: int | None = None,
) -> VideoEncoder:
    """The encoder called ``name``: json, pbvd or h264.

    ``keyframe_interval``: pictures from one key frame to the next; None means as many as come in a third of a second
    (the paper's rule), for h264 in four. Raises ConfigError for an unknown name, PebbleError saying what to install.
    """
    if keyframe_interval is None:
        keyframe_interval = round(fps * _H264_INTERVAL_S) if name == "h264" else int(fps / 3)
    interval = max(1, keyframe_interval)
    match name:
        case "json":
            return JsonEncoder(interval, quality)
        case "pbvd":
            return PbvdEncoder(interval, quality)
        case "h264":
            return H264VideoEncoder(fps, interval, quality, bitrate)
    raise ConfigError(f"video encoding {name!r}: unknown; there are {', '.join(ALL_VIDEO)}")


def _packet(kind: PictureKind, frame: int, captured_ms: int, body: bytes, flags: int = 0) -> bytes:
    """The header has no times before 1970: a clock that is not set yet counts as unknown, which is 0."""
    return Picture(kind, frame, max(0, captured_ms), body, flags).pack()


class _JpegEncoder(ABC):
    """The common part of the encodings made of JPEGs."""

    optimize = True

    def __init__(self, interval: int, quality: float) -> None:
        self.last_was_keyframe = False
        self.bitrate: int | None = None
        self._delta = JpegDelta(interval=interval, quality=quality, optimize=self.optimize)
        self._frame = 0

    @property
    def quality(self) -> float:
        return self._delta.quality

    @quality.setter
    def quality(self, quality: float) -> None:
        self._delta.quality = quality

    def encode(self, picture: Pixels, captured_ms: int, *, keyframe: bool = False) -> bytes:
        coded = self._delta.code(picture, keyframe=keyframe)
        self.last_was_keyframe = coded.keyframe
        frame = self._frame
        self._frame = (frame + 1) % SEQUENCE_LIMIT
        return self._pack(coded.jpeg, coded.keyframe, frame, captured_ms)

    @abstractmethod
    def _pack(self, jpeg: bytes, keyframe: bool, frame: int, captured_ms: int) -> bytes: ...


class JsonEncoder(_JpegEncoder):
    """Paper 8.8: the encoding that every operator page decodes."""

    name = "json"

    def _pack(self, jpeg: bytes, keyframe: bool, frame: int, captured_ms: int) -> bytes:
        return JsonPicture(frame, keyframe, captured_ms, jpeg).pack()


class PbvdEncoder(_JpegEncoder):
    """A binary header and the bare JPEG."""

    name = "pbvd"

    def _pack(self, jpeg: bytes, keyframe: bool, frame: int, captured_ms: int) -> bytes:
        kind = PictureKind.JPEG if keyframe else PictureKind.DELTA_JPEG
        return _packet(kind, frame, captured_ms, jpeg)


class H264VideoEncoder:
    """A binary header and one access unit."""

    name = "h264"

    def __init__(self, fps: float, interval: int, quality: float, bitrate: int | None) -> None:
        self.last_was_keyframe = False
        self._codec = H264Encoder(fps=fps, interval=interval, quality=quality, bitrate=bitrate)
        self._frame = 0

    @property
    def quality(self) -> float:
        return self._codec.quality

    @quality.setter
    def quality(self, quality: float) -> None:
        self._codec.quality = quality

    @property
    def bitrate(self) -> int | None:
        return self._codec.bitrate

    @bitrate.setter
    def bitrate(self, bitrate: int | None) -> None:
        self._codec.bitrate = bitrate

    def encode(self, picture: Pixels, captured_ms: int, *, keyframe: bool = False) -> bytes:
        unit = self._codec.encode(picture, keyframe=keyframe)
        self.last_was_keyframe = self._codec.keyframe
        frame = self._frame
        self._frame = (frame + 1) % SEQUENCE_LIMIT
        flags = KEY_FRAME if self.last_was_keyframe else 0
        return _packet(PictureKind.H264, frame, captured_ms, unit, flags)
