"""One frame of ``pebble_serial_v1``: COBS(body, CRC-16), ended by a zero. Bytes in and out, no I/O."""

from __future__ import annotations

import binascii
import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from pebble.errors import PayloadError
from pebble.services.serial_mcu_bridge import cobs

VERSION: Final = 1
END: Final = b"\0"

#: Of what stands between two zeros. A manifest is the longest frame there is: 32 interfaces of 8 fields each are about
#: 7,000 bytes, and sending more would take an MCU most of a second at 115,200 baud. What has no end is no frame.
FRAME_LIMIT: Final = 8192

_HEAD = struct.Struct("<BBBHII")  # version, type, flags, interface, sequence, timestamp; no padding
_CRC = struct.Struct("<H")
_CRC_START = 0xFFFF  # CRC-16/CCITT-FALSE: crc_hqx has its polynomial, 0x1021, and reflects nothing
_U32 = 0xFFFFFFFF


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
    """Bytes that are no frame. ``subject`` is one of few words, to count by."""

    def __init__(self, subject: str, text: str) -> None:
        self.subject = subject
        super().__init__(text)


@dataclass(frozen=True, slots=True)
class Frame:
    """``interface`` 0 is the protocol itself; ``timestamp`` is milliseconds of the sender's clock, modulo 2**32."""

    type: Type
    payload: bytes = b""
    interface: int = 0
    sequence: int = 0
    timestamp: int = 0


def crc(body: bytes) -> int:
    """CRC-16/CCITT-FALSE; of ``123456789`` it is 0x29B1."""
    return binascii.crc_hqx(body, _CRC_START)


def encode(frame: Frame) -> bytes:
    """The frame as it goes down the line, its ending zero included."""
    head = _HEAD.pack(VERSION, frame.type, 0, frame.interface, frame.sequence & _U32, frame.timestamp & _U32)
    body = head + frame.payload
    return cobs.encode(body + _CRC.pack(crc(body))) + END


def decode(stuffed: bytes) -> Frame:
    """The frame between two zeros. Raises FrameError and nothing else. Flags are the future's and not looked at."""
    try:
        whole = cobs.decode(stuffed)
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
        known = Type(kind)
    except ValueError:
        raise FrameError("type", f"a frame of the unknown type 0x{kind:02x}") from None
    return Frame(known, body[_HEAD.size :], interface, sequence, timestamp)
