"""zlib with a limit: what arrives from outside may be a few kilobytes that unpack to gigabytes."""

from __future__ import annotations

import zlib

from pebble.errors import PayloadError


def inflate(packed: bytes, limit: int) -> bytes:
    """The one complete zlib stream that ``packed`` is, at most ``limit`` bytes of it; else PayloadError.

    zlib ends with a checksum of what was packed, so whatever comes out is what went in.
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
