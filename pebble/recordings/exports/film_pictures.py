"""The pictures of a film, in a file of their own.

H.264 is copied as it was sent as long as one set of parameters decodes all of it. Other pictures, or parameters that
change, make the film be encoded: what was copied so far is decoded and encoded, too.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pebble.contract.packets import KEY_FRAME, PBVD, Picture, PictureKind
from pebble.errors import PayloadError

if TYPE_CHECKING:
    from pebble.media.jpeg import Pixels

QUALITY: Final = 70.0  # of pictures that are encoded, as of a JPEG
_KEYFRAME_INTERVAL: Final = 60  # pictures: how far a player jumps
_NOMINAL_FPS: Final = 15.0  # for the encoder; the times of pictures are their stamps
MILLISECOND: Final = Fraction(1, 1000)

_start_codes = re.compile(rb"\x00\x00\x01")
_PARAMETER_SETS: Final = (7, 8)  # types of NAL units: ITU-T H.264, 7.4.1


class _CannotCopyError(Exception):
    """A picture that does not fit those copied so far."""


class _Units:
    """A file of H.264 access units, which are what ``first`` is: Annex B with its parameter sets."""

    def __init__(self, av: Any, path: Path, first: bytes) -> None:
        """Raises PayloadError, or FFmpeg's error, if ``first`` is none."""
        self._packet = av.Packet
        with av.open(io.BytesIO(first), format="h264") as source:
            stream = source.streams.video[0]
            self.width, self.height = stream.width, stream.height
            if not (self.width and self.height):
                raise PayloadError("h264: parameter sets that no decoder takes")
            self._out = av.open(str(path), "w", format="matroska")
            self._stream = self._out.add_stream_from_template(stream, opaque=True)
        self._stream.time_base = MILLISECOND
        self.last_ms = -1

    def add(self, unit: bytes, at_ms: int, *, keyframe: bool) -> None:
        """A unit whose time is not after the last one's is shown a millisecond after it: later ones build on it."""
        packet = self._packet(unit)
        self.last_ms = max(at_ms, self.last_ms + 1)
        packet.pts = packet.dts = self.last_ms
        packet.time_base, packet.stream, packet.is_keyframe = MILLISECOND, self._stream, keyframe
        self._out.mux(packet)

    def close(self) -> None:
        self._out.close()


class _Copier:
    """Chooses the H.264 units that can be shown: from a key frame on, without a gap, undamaged."""

    def __init__(self) -> None:
        self._due: int | None = None  # the number that the next unit must have, unless it is a key frame
        self._parameters: list[bytes] | None = None

    def take(self, payload: bytes) -> tuple[Picture, bytes] | None:
        """The packet and its unit; None if it is left out. Raises _CannotCopyError."""
        from pebble.media.h264 import check_unit, unseal

        if not payload.startswith(PBVD):
            raise _CannotCopyError
        due, self._due = self._due, None
        try:
            packet = Picture.unpack(payload)
            keyframe = bool(packet.flags & KEY_FRAME)
            if packet.kind != PictureKind.H264:
                raise _CannotCopyError
            if not keyframe and packet.frame != due:
                return None
            unit = unseal(packet.body)
            check_unit(unit, keyframe)
        except PayloadError:
            return None
        if keyframe:
            self._compare(parameter_sets(unit))
        self._due = (packet.frame + 1) % (1 << 32)
        return packet, unit

    def _compare(self, parameters: list[bytes]) -> None:
        if self._parameters is None:
            self._parameters = parameters
        elif self._parameters != parameters:
            raise _CannotCopyError


class PictureTrack:
    """The film's pictures, in a file of their own."""

    def __init__(self, av: Any, folder: Path, quality: float) -> None:
        self.path = folder / "copied.mkv"
        self.count = self.left_out = 0
        self._av, self._folder, self._quality = av, folder, quality
        self._copier = _Copier()
        self._encoder: _Encoder | None = None  # None: they are copied
        self._units: _Units | None = None
        self.size = (0, 0)

    def add(self, payload: bytes, place: Callable[[int | None], int]) -> None:
        """``place`` gives the time of a capture stamp."""
        try:
            taken = (
                self._copied(payload, place) if self._encoder is None else self._encoded(self._encoder, payload, place)
            )
        except _CannotCopyError:
            taken = self._encoded(self._encode_what_was_copied(), payload, place)
        self.count += taken
        self.left_out += not taken

    def close(self) -> None:
        if self._units is not None:
            self._units.close()
            self.size = self._units.width, self._units.height

    @property
    def last_ms(self) -> int:
        return 0 if self._units is None else self._units.last_ms

    @property
    def copied(self) -> bool:
        return self._encoder is None

    @property
    def scaled(self) -> int:
        return 0 if self._encoder is None else self._encoder.scaled

    def _copied(self, payload: bytes, place: Callable[[int | None], int]) -> bool:
        taken = self._copier.take(payload)
        if taken is None:
            return False
        packet, unit = taken
        try:
            self._add(unit, place(packet.captured_ms or None), keyframe=bool(packet.flags & KEY_FRAME))
        except (PayloadError, self._av.error.InvalidDataError):
            self._copier = _Copier()
            return False
        return True

    def _encoded(self, encoder: _Encoder, payload: bytes, place: Callable[[int | None], int]) -> bool:
        decoded = encoder.decoder.feed(payload)
        if decoded is None:
            return False
        self._encode(encoder, decoded.picture, place(decoded.captured_ms))
        return True

    def _encode(self, encoder: _Encoder, picture: Pixels, at_ms: int) -> None:
        unit, keyframe = encoder.encode(picture)
        self._add(unit, at_ms, keyframe=keyframe)

    def _add(self, unit: bytes, at_ms: int, *, keyframe: bool) -> None:
        if self._units is None:
            self._units = _Units(self._av, self.path, unit)
        self._units.add(unit, at_ms, keyframe=keyframe)

    def _encode_what_was_copied(self) -> _Encoder:
        encoder = self._encoder = _Encoder(self._quality)
        copied, self.path = self.path, self._folder / "encoded.mkv"
        if self._units is not None:
            self._units.close()
            self._units = None
            with self._av.open(str(copied)) as source:
                for frame in self._decoded(source):
                    self._encode(encoder, frame.to_ndarray(format="bgr24"), round(frame.time * 1000))
            copied.unlink()
        return encoder

    def _decoded(self, source: Any) -> Iterator[Any]:
        for packet in source.demux(video=0):
            try:
                yield from packet.decode()
            except self._av.error.InvalidDataError:  # undamaged, but no H.264: it was never a picture
                self.count -= 1
                self.left_out += 1


class _Encoder:
    """Pictures of any size and encoding to H.264 of one size, that of the first."""

    def __init__(self, quality: float) -> None:
        from pebble.media.decode import VideoDecoder
        from pebble.media.h264 import H264Encoder

        self.decoder = VideoDecoder()
        self.scaled = 0
        self._h264 = H264Encoder(fps=_NOMINAL_FPS, interval=_KEYFRAME_INTERVAL, quality=quality)
        self._shape: tuple[int, ...] | None = None

    def encode(self, picture: Pixels) -> tuple[bytes, bool]:
        """An access unit, and whether it is a key frame."""
        from pebble.media.h264 import unseal

        self._shape = self._shape or picture.shape
        if picture.shape != self._shape:
            picture = _fitted(picture, self._shape)
            self.scaled += 1
        return unseal(self._h264.encode(picture)), self._h264.keyframe


def parameter_sets(unit: bytes) -> list[bytes]:
    """The parameter sets of an access unit in Annex B, without start codes."""
    units = (part.rstrip(b"\0") for part in _start_codes.split(unit))
    return [part for part in units if part and part[0] & 31 in _PARAMETER_SETS]


def _fitted(picture: Pixels, shape: tuple[int, ...]) -> Pixels:
    """The picture becomes as large as fits into ``shape``, in its middle, on black."""
    import cv2
    import numpy as np

    scale = min(shape[0] / picture.shape[0], shape[1] / picture.shape[1])
    height, width = (max(1, round(edge * scale)) for edge in picture.shape[:2])
    top, left = (shape[0] - height) // 2, (shape[1] - width) // 2
    made = np.zeros(shape, np.uint8)
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    made[top : top + height, left : left + width] = cv2.resize(picture, (width, height), interpolation=way)
    return made
