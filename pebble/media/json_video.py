"""Pictures as JSON: id, keyframe, base64 of the zlib of a JPEG, seconds (paper 8.8)."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Annotated, Final

import msgspec

from pebble.errors import PayloadError
from pebble.media.jpeg import MAX_BYTES
from pebble.media.picture_header import milliseconds

_MAX_TEXT: Final = MAX_BYTES * 4 // 3 + 1024


class _Message(msgspec.Struct):
    id: Annotated[int, msgspec.Meta(ge=0, lt=1 << 53)]
    keyframe: bool
    data: bytes  # msgspec reads and writes bytes as base64
    timestamp: float | None = None


_encoder = msgspec.json.Encoder()
_decoder = msgspec.json.Decoder(_Message)


@dataclass(frozen=True, slots=True)
class JsonPicture:
    """One message. ``jpeg``: a full picture, or a difference plus 128. ``captured_ms``: epoch, None if implausible."""

    frame: int
    keyframe: bool
    captured_ms: int | None
    jpeg: bytes

    def pack(self) -> bytes:
        packed = zlib.compress(self.jpeg)
        seconds = None if self.captured_ms is None else self.captured_ms / 1000
        return _encoder.encode(_Message(self.frame, self.keyframe, packed, seconds))

    @classmethod
    def unpack(cls, raw: bytes) -> JsonPicture:
        """Raises PayloadError for anything that is no complete message."""
        if len(raw) > _MAX_TEXT:
            raise PayloadError(f"JSON picture: {len(raw)} bytes")
        try:
            message = _decoder.decode(raw)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, ValueError) as error:
            raise PayloadError(f"JSON picture: {error}") from None
        jpeg = inflate(message.data, MAX_BYTES)
        return cls(message.id, message.keyframe, milliseconds(message.timestamp), jpeg)


def inflate(packed: bytes, limit: int) -> bytes:
    """Unpack the one complete zlib stream in ``packed``. Raises PayloadError for anything else.

    The limit matters because a few kilobytes may unpack to gigabytes. zlib ends with a checksum of the content.
    """
    unpacker = zlib.decompressobj()
    try:
        plain = unpacker.decompress(packed, limit)
        if not unpacker.eof:  # zlib may have the last byte out, and its checksum still to come
            plain += unpacker.decompress(unpacker.unconsumed_tail, 1)
    except zlib.error as error:
        raise PayloadError(f"zlib: {error}") from None
    if len(plain) > limit:
        raise PayloadError(f"zlib: unpacks to more than {limit} bytes")
    if not unpacker.eof:
        raise PayloadError("zlib: cut short")
    if unpacker.unused_data:
        raise PayloadError("zlib: something follows the stream")
    return plain
