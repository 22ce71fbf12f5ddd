"""One frame of ``pebble_serial_v1``: COBS(body, CRC-16) and a zero. Bytes in and out, no I/O."""

import binascii
import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from pebble.errors import PayloadError

VERSION: Final = 1
END: Final = b"\0"

#: Bytes between two zeros; they take 0.7 s at 115,200 baud. The longest frame is a manifest: one of 32 interfaces with
#: 8 fields each is about 7,000 bytes. A longer frame is discarded and counted, so a larger manifest is never accepted.
FRAME_LIMIT: Final = 8192

_HEAD = struct.Struct("<BBBHII")  # version, type, flags, interface, sequence, timestamp; no padding
_CRC = struct.Struct("<H")
_CRC_START = 0xFFFF  # CRC-16/CCITT-FALSE: crc_hqx has its polynomial, 0x1021, and reflects nothing
_U32 = 0xFFFFFFFF
_BLOCK = 254  # bytes of a full COBS block; its code 0xFF means that no zero follows


class Type(IntEnum):
    HELLO = 0x01
    DESCRIBE_REQ = 0x02
    DESCRIBE = 0x03
    SAMPLE = 0x10
    STATE = 0x11
    CMD = 0x20
    ACK = 0x21
    NACK = 0x22
    LOG = 0x30
    PING = 0x31
    PONG = 0x32


class FrameError(PayloadError):
    """An error: bytes that are no valid frame. ``subject`` is the kind of error, for counters."""

    def __init__(self, subject: str, text: str) -> None:
        self.subject = subject
        super().__init__(text)


@dataclass(frozen=True, slots=True)
class Frame:
    """A frame. ``interface`` 0 is the protocol itself; ``timestamp``: ms on the sender's 32-bit clock."""

    type: Type
    payload: bytes = b""
    interface: int = 0
    sequence: int = 0
    timestamp: int = 0


def crc(body: bytes) -> int:
    """Return the CRC-16/CCITT-FALSE; of ``123456789`` it is 0x29B1."""
    return binascii.crc_hqx(body, _CRC_START)


def encode(frame: Frame) -> bytes:
    """Return the frame as bytes, with its ending zero."""
    head = _HEAD.pack(VERSION, frame.type, 0, frame.interface, frame.sequence & _U32, frame.timestamp & _U32)
    body = head + frame.payload
    return stuff(body + _CRC.pack(crc(body))) + END


def decode(stuffed: bytes) -> Frame:
    """Decode the bytes between two zeros. Raises only FrameError. The flags are reserved and ignored."""
    try:
        whole = unstuff(stuffed)
    except PayloadError as error:
        raise FrameError("stuffing", f"a frame of {len(stuffed)} bytes {error}") from None
    body, checksum = whole[: -_CRC.size], whole[-_CRC.size :]
    if len(body) < _HEAD.size:
        raise FrameError("short", f"a frame of {len(whole)} bytes is too short")
    if _CRC.unpack(checksum)[0] != crc(body):
        raise FrameError("crc", f"a frame of {len(whole)} bytes has a wrong checksum")
    version, kind, _flags, interface, sequence, timestamp = _HEAD.unpack_from(body)
    if version != VERSION:
        raise FrameError("version", f"a frame of version {version}; {VERSION} is understood")
    try:
        type_ = Type(kind)
    except ValueError:
        raise FrameError("type", f"a frame of the unknown type 0x{kind:02x}") from None
    return Frame(type_, body[_HEAD.size :], interface, sequence, timestamp)


def stuff(data: bytes) -> bytes:
    """Return ``data`` in COBS, which contains no zero: a zero can then end the frame (Cheshire and Baker 1997).

    The result is longer by at most one byte per 254, plus one.
    """
    blocks = bytearray()
    *closed, last = data.split(b"\0")
    for part in closed:
        blocks += _full_blocks(part) + _block(part)
    blocks += _full_blocks(last)
    if not last or len(last) % _BLOCK:  # else it ends with a full block, which implies no zero
        blocks += _block(last)
    return bytes(blocks)


def unstuff(stuffed: bytes) -> bytes:
    """Return the data that :func:`stuff` was given. Raises PayloadError for bytes that it cannot have returned."""
    data = bytearray()
    at, end = 0, len(stuffed)
    while at < end:
        code = stuffed[at]  # how many bytes the block has, this one included
        block = stuffed[at + 1 : at + code]
        if code == 0 or len(block) != code - 1 or 0 in block:
            raise PayloadError("is not byte-stuffed")
        data += block
        at += code
        if code <= _BLOCK and at < end:  # unless it is full, or the last, a block stands for a zero after it, too
            data.append(0)
    return bytes(data)


def _full_blocks(part: bytes) -> bytes:
    starts = range(0, len(part) - _BLOCK + 1, _BLOCK)
    return b"".join(b"\xff" + part[start : start + _BLOCK] for start in starts)


def _block(part: bytes) -> bytes:
    """Return ``part``'s last COBS block: the bytes after its full blocks. If another follows, it implies a zero."""
    last = part[len(part) - len(part) % _BLOCK :]
    return bytes((len(last) + 1,)) + last
