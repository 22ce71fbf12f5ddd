"""Pictures as JSON: id, keyframe, base64 of the zlib of a JPEG, seconds (paper 8.8)."""

import zlib
from typing import Annotated

import msgspec

from pebble.errors import PayloadError
from pebble.extensions.media.jpeg import MAX_BYTES


class _Message(msgspec.Struct):
    id: Annotated[int, msgspec.Meta(ge=0, lt=1 << 53)]
    keyframe: bool
    data: bytes  # msgspec reads and writes bytes as base64
    timestamp: float | None = None


_encoder = msgspec.json.Encoder()
_decoder = msgspec.json.Decoder(_Message)


def pack(frame: int, keyframe: bool, captured_ms: int | None, jpeg: bytes) -> bytes:
    """Return one message. ``jpeg``: a full picture, or 128 plus the difference from the last (jpeg_delta.py)."""
    seconds = None if captured_ms is None else captured_ms / 1000
    return _encoder.encode(_Message(frame, keyframe, zlib.compress(jpeg), seconds))


def jpeg_of(raw: bytes) -> bytes:
    """Return the JPEG in a message. Raises PayloadError if the message is incomplete, or something else."""
    try:
        packed = _decoder.decode(raw).data
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, ValueError) as error:
        raise PayloadError(f"JSON picture: {error}") from None
    return inflate(packed, MAX_BYTES)


def inflate(packed: bytes, limit: int) -> bytes:
    """Return the content of ``packed``, one complete zlib stream. Raises PayloadError for anything else.

    The limit matters because a few kilobytes may unpack to gigabytes. zlib ends with a checksum of the content.
    """
    unpacker = zlib.decompressobj()
    try:
        plain = unpacker.decompress(packed, limit)
        if not unpacker.eof:  # the content may be complete, and its checksum not read yet
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
