"""Binary headers of media: PBAT for sound, PBVD for pictures. Pure: bytes in, bytes out.

Layouts: paper 8.9 and A.8.8, and the newest revision of the reference implementation. All numbers are big-endian.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from pebble.errors import PayloadError

PBAT: Final = b"PBAT"
PBVD: Final = b"PBVD"
VERSION: Final = 1
SEQUENCE_LIMIT: Final = 1 << 32  # numbers begin again

_SOUND = struct.Struct(">4sBBBBHHIQ")  # 24 bytes
_PICTURE = struct.Struct(">4sBBBIQ")  # 19 bytes


class Codec(IntEnum):
    """The encoding of the body of a PBAT packet."""

    PCM16LE = 1  # interleaved samples
    OPUS = 2  # one or more Opus packets; see pebble.extensions.media.opus


class PictureKind(IntEnum):
    """The kind of a PBVD packet's body. Old decoders ignore flags, so every new meaning is a new kind."""

    JPEG = 1  # a full picture
    DELTA_JPEG = 2  # reference + (decoded - 128)
    ZLIB_JPEG = 3  # the same two, compressed once more
    ZLIB_DELTA_JPEG = 4
    H264 = 5  # one access unit, Annex B; flag 1: a key frame


KEY_FRAME: Final = 1  # flag of H264


@dataclass(frozen=True, slots=True)
class Sound:
    """A PBAT packet. ``samples`` counts per channel; ``captured_ms`` is the epoch time of the first sample."""

    codec: int
    channels: int
    rate: int  # Hz, at most 65,535
    samples: int
    sequence: int  # 32 bits; after the highest comes 1
    captured_ms: int
    body: bytes
    flags: int = 0

    def pack(self) -> bytes:
        """Return the packet as bytes. Raises PayloadError for numbers that the header cannot hold."""
        try:
            head = _SOUND.pack(
                PBAT, VERSION, self.codec, self.channels, self.flags,
                self.rate, self.samples, self.sequence, self.captured_ms,
            )  # fmt: skip
        except struct.error as error:
            raise PayloadError(f"PBAT: {error}") from None
        return head + self.body

    @classmethod
    def unpack(cls, raw: bytes) -> Sound:
        """Return the packet in ``raw``. Raises PayloadError if it is no PBAT packet of version 1 with sound in it."""
        if len(raw) < _SOUND.size:
            raise PayloadError(f"PBAT: {len(raw)} bytes, less than its header")
        magic, version, codec, channels, flags, rate, samples, sequence, captured_ms = _SOUND.unpack_from(raw)
        if magic != PBAT or version != VERSION:
            raise PayloadError("PBAT: not a packet of version 1")
        if not (channels and rate and samples):
            raise PayloadError("PBAT: no channels, no rate or no samples")
        return cls(codec, channels, rate, samples, sequence, captured_ms, raw[_SOUND.size :], flags)


@dataclass(frozen=True, slots=True)
class Picture:
    """A PBVD packet."""

    kind: int
    frame: int  # 32 bits, wraps
    captured_ms: int
    body: bytes
    flags: int = 0

    def pack(self) -> bytes:
        """Return the packet as bytes. Raises PayloadError for numbers that the header cannot hold."""
        try:
            head = _PICTURE.pack(PBVD, VERSION, self.kind, self.flags, self.frame, self.captured_ms)
        except struct.error as error:
            raise PayloadError(f"PBVD: {error}") from None
        return head + self.body

    @classmethod
    def unpack(cls, raw: bytes) -> Picture:
        """Return the packet in ``raw``. Raises PayloadError if it is no PBVD packet of version 1."""
        if len(raw) < _PICTURE.size:
            raise PayloadError(f"PBVD: {len(raw)} bytes, less than its header")
        magic, version, kind, flags, frame, captured_ms = _PICTURE.unpack_from(raw)
        if magic != PBVD or version != VERSION:
            raise PayloadError("PBVD: not a packet of version 1")
        return cls(kind, frame, captured_ms, raw[_PICTURE.size :], flags)
