"""H.264 through PyAV: one access unit per picture, without delay, as no picture waits for a later one.

The format is Annex B, with parameter sets in every key frame, so a receiver can begin at any of them (ITU-T H.264,
annex B, 7.4.1.2). The last NAL unit of a picture is our seal: the CRC-32 of everything before it, as type 31, which the
standard leaves to applications and decoders skip. It is needed because neither a PBVD packet nor a slice has a length,
and FFmpeg shows a slice whose last bytes are missing.
"""

from __future__ import annotations

import math
import zlib
from fractions import Fraction
from typing import TYPE_CHECKING, Final, cast

import cv2

from pebble.errors import PayloadError, PebbleError
from pebble.extensions.media import pyav
from pebble.extensions.media.jpeg import MAX_EDGE, Pixels

if TYPE_CHECKING:
    import av

SMALLEST_EDGE: Final = 16  # one macroblock

_SEAL: Final = b"\x00\x00\x00\x01\x1f"
_SEAL_BYTES: Final = len(_SEAL) + 5
_WORST_CRF: Final = 51.0
_REST_S: Final = 1.0  # so long a picture rests before it is sent sharp, once in each key frame
_SHARPER: Final = "10"  # ipratio: a key frame has this part of the other pictures' coarseness
_GRID: Final = (40, 24)  # the size to which pictures are reduced to compare them: it averages noise away
_RESTS: Final = 3.0  # of 255: no part of a picture that rests differs more


def quality_to_crf(quality: float) -> float:
    """Return the constant rate factor that keeps as much (SSIM) as JPEG at ``quality``, fitted on a panning scene.

    Measured pairs: 5 → 49.5, 10 → 42.8, 20 → 35.4, 40 → 28.9, 70 → 23.4.
    """
    return min(_WORST_CRF, 43 - 7 * math.log2(max(1.0, quality) / 10))


class H264Encoder:
    """An encoder of BGR pictures to access units; ``interval``: pictures from one key frame to the next.

    Another size or quality starts the codec anew, with a key frame. So does a picture that has stayed the same for a
    second: this key frame is coded sharply, and the units after it change nothing.
    """

    def __init__(self, fps: float, interval: int) -> None:
        self.keyframe = False  # was the last one a key frame?
        self._interval = interval
        self._rate = Fraction(fps).limit_denominator(1000)
        self._av = pyav.load("h264")
        try:
            self._av.codec.Codec("libx264", "w")
        except ValueError:  # UnknownCodecError
            raise PebbleError("h264: this PyAV was built without libx264") from None
        self._context: av.VideoCodecContext | None = None
        self._opened_for: tuple[object, ...] = ()  # the arguments of _open for this context
        self._count = 0  # pictures so far: the time stamp of the next one
        self._i420: Pixels | None = None  # the last picture as the codec takes it; cv2 writes the next one into it
        self._reduced: Pixels | None = None  # the picture with which others are compared
        self._resting = 0  # pictures that have not differed from it

    def encode(self, picture: Pixels, quality: float, *, keyframe: bool = False) -> bytes:
        """Return one access unit. An odd last row or column is left out: colour is stored for two by two pixels."""
        height, width = picture.shape[0] & ~1, picture.shape[1] & ~1
        if min(height, width) < SMALLEST_EDGE:
            raise PebbleError(f"h264: a picture of {picture.shape[1]}x{picture.shape[0]} is too small")
        settings = (width, height, quality, self._rests(picture))
        if self._context is None or self._opened_for != settings:
            self._context, self._opened_for = self._open(*settings), settings
        self._i420 = cast(Pixels, cv2.cvtColor(picture[:height, :width], cv2.COLOR_BGR2YUV_I420, self._i420))
        frame = self._av.VideoFrame.from_ndarray(self._i420, "yuv420p")
        frame.pts = self._count
        self._count += 1
        if keyframe:
            frame.pict_type = self._av.video.frame.PictureType.I
        try:
            packets = self._context.encode(frame)
        except self._av.error.FFmpegError as error:
            self._context = None
            raise PebbleError(f"h264: {error}") from None
        self.keyframe = any(packet.is_keyframe for packet in packets)
        return seal(b"".join(bytes(packet) for packet in packets))

    def _rests(self, picture: Pixels) -> bool:
        """True if the picture is the same as those of the last second."""
        reduced = cv2.resize(picture, _GRID, interpolation=cv2.INTER_AREA)
        if self._reduced is None or cv2.absdiff(reduced, self._reduced).max() > _RESTS:
            self._reduced, self._resting = cast(Pixels, reduced), 0
        self._resting += 1
        return self._resting > self._rate * _REST_S

    def _open(self, width: int, height: int, quality: float, rests: bool) -> av.VideoCodecContext:
        context: av.VideoCodecContext = self._av.CodecContext.create("libx264", "w")
        context.width, context.height, context.pix_fmt = width, height, "yuv420p"
        context.time_base, context.framerate = 1 / self._rate, self._rate
        context.gop_size = self._interval
        context.max_b_frames = 0
        context.thread_count = 1  # zerolatency would cut the picture into a slice per thread
        context.colorspace = 6  # SMPTE 170M, what cv2 converts to
        context.color_range = 1  # 16..235
        # No look-ahead, no waiting; veryfast: 3 ms for 640x480 where medium takes 10 and saves nothing at this latency.
        parameters = "scenecut=0" + (f":ipratio={_SHARPER}" if rests else "")
        options = {"preset": "veryfast", "tune": "zerolatency", "forced-idr": "1", "x264-params": parameters}
        context.options = options | {"crf": f"{quality_to_crf(quality):.2f}"}
        return context


class H264Decoder:
    """A decoder of access units to BGR pictures. Refuses a picture if FFmpeg reports that it has repaired it."""

    def __init__(self) -> None:
        self._av = pyav.load("h264")
        self._context: av.VideoCodecContext | None = None

    def decode(self, unit: bytes, *, keyframe: bool) -> Pixels:
        """Return a unit's picture. PayloadError if it is cut, damaged or too large: then a key frame must come."""
        try:
            return self._picture(self._frame(unit, keyframe))
        except PayloadError:
            self._context = None  # its reference pictures are no longer the sender's
            raise
        except (self._av.error.FFmpegError, ValueError, MemoryError) as error:
            self._context = None
            raise PayloadError(f"h264: {error}") from None

    def _frame(self, unit: bytes, keyframe: bool) -> av.VideoFrame:
        if self._context is None:
            if not keyframe:
                raise PayloadError("h264: no key frame yet")
            self._context = self._open()
        frames = self._context.decode(self._av.Packet(unseal(unit)))
        if len(frames) != 1:
            raise PayloadError(f"h264: {len(frames)} pictures in what should be one")
        if frames[0].is_corrupt:
            raise PayloadError("h264: damaged")
        if max(frames[0].width, frames[0].height) > MAX_EDGE:
            raise PayloadError(f"h264: {frames[0].width}x{frames[0].height}")
        return frames[0]

    def _open(self) -> av.VideoCodecContext:
        context: av.VideoCodecContext = self._av.CodecContext.create("h264", "r")
        context.thread_count = 1  # threads would each hold a picture back
        # explode: errors are errors; ec=0: nothing is guessed.
        context.options = {
            "flags": "+low_delay",
            "err_detect": "explode",
            "ec": "0",
            "max_pixels": str(MAX_EDGE * MAX_EDGE),
        }
        return context

    @staticmethod
    def _picture(frame: av.VideoFrame) -> Pixels:
        if frame.format.name != "yuv420p":
            return cast(Pixels, frame.to_ndarray(format="bgr24"))
        return cast(Pixels, cv2.cvtColor(frame.to_ndarray(), cv2.COLOR_YUV2BGR_I420))


def seal(unit: bytes) -> bytes:
    """Return the unit with its checksum, in bytes of seven bits with the top bit set: no start code arises."""
    crc = zlib.crc32(unit)
    return unit + _SEAL + bytes(crc >> shift & 0x7F | 0x80 for shift in (28, 21, 14, 7, 0))


def unseal(sealed: bytes) -> bytes:
    """Return the unit without its seal. Raises PayloadError if the seal is missing or wrong."""
    unit = sealed[:-_SEAL_BYTES]
    if seal(unit) != sealed:
        raise PayloadError("h264: cut short or damaged")
    return unit
