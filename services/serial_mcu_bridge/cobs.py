"""Consistent overhead byte stuffing (Cheshire and Baker 1997): a frame without zeros, so that a zero can end it."""

from __future__ import annotations

from pebble.errors import PayloadError

_LONGEST = 254  # bytes of one block; its code 0xFF says that no zero follows


def encode(data: bytes) -> bytes:
    """``data`` without zeros, at most one byte in 254 longer, and one; the ending zero is the caller's."""
    blocks = bytearray()
    *closed, last = data.split(b"\0")
    for part in closed:
        blocks += _full_blocks(part) + _block(part)
    blocks += _full_blocks(last)
    if not last or len(last) % _LONGEST:  # else the last full block ends it all
        blocks += _block(last)
    return bytes(blocks)


def decode(stuffed: bytes) -> bytes:
    """What :func:`encode` made ``stuffed`` of. Raises PayloadError for what it cannot have made."""
    data = bytearray()
    at, end = 0, len(stuffed)
    while at < end:
        code = stuffed[at]
        block = stuffed[at + 1 : at + code]
        if code == 0 or len(block) != code - 1 or 0 in block:
            raise PayloadError("is not byte-stuffed")
        data += block
        at += code
        if code <= _LONGEST and at < end:
            data.append(0)
    return bytes(data)


def _full_blocks(part: bytes) -> bytes:
    starts = range(0, len(part) - _LONGEST + 1, _LONGEST)
    return b"".join(b"\xff" + part[start : start + _LONGEST] for start in starts)


def _block(part: bytes) -> bytes:
    """The last block of ``part``, shorter than a full one; a zero follows it, or the end."""
    rest = part[len(part) - len(part) % _LONGEST :]
    return bytes((len(rest) + 1,)) + rest
