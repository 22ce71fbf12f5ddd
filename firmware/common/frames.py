"""Frames of pebble_serial_v1 on the MCU's side: COBS around a header, a payload and a CRC-16. Pure.

A frame is COBS(version, type, flags, interface u16, sequence u32, milliseconds u32, payload, crc u16), then a zero
byte; little-endian. The CRC is CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF, nothing reflected.
"""

import struct

from micropython import const

_VERSION = const(1)
_HEADER = "<BBBHII"
_HEADER_SIZE = const(13)
_AROUND = const(20)  # header, CRC, up to four lengths of COBS, the zero: payloads up to 1000 bytes
_LIMIT = const(160)  # bytes of a frame to the MCU, as it is on the wire
_LONGEST_RUN = const(255)
#: Remainders of the upper four bits: half a byte at a time needs a sixteenth of the memory
_CRC = (
    0x0000, 0x1021, 0x2042, 0x3063, 0x4084, 0x50A5, 0x60C6, 0x70E7,
    0x8108, 0x9129, 0xA14A, 0xB16B, 0xC18C, 0xD1AD, 0xE1CE, 0xF1EF,
)  # fmt: skip


def crc16(data: bytes | bytearray, size: int) -> int:
    """Return the CRC-16/CCITT-FALSE of the first ``size`` bytes."""
    crc, table = 0xFFFF, _CRC
    for index in range(size):
        crc ^= data[index] << 8
        crc = (crc << 4 & 0xFFFF) ^ table[crc >> 12]
        crc = (crc << 4 & 0xFFFF) ^ table[crc >> 12]
    return crc


class Sender:
    """Frames for the host, queued in ``ring``: ``used`` bytes from ``first`` on, wrapping around its end.

    They are COBS-encoded in place, so a long manifest needs no second buffer.
    """

    def __init__(self, size: int) -> None:
        self.ring = bytearray(size)
        self.first = self.used = 0
        self._header = bytearray(_HEADER_SIZE)

    def send(self, kind: int, interface: int, sequence: int, now: int, data: bytes | bytearray) -> bool:
        """Queue a frame with the time ``now`` in milliseconds. False: no room, and the frame is dropped.

        COBS writes each run of bytes up to a zero, or of 254 at most, behind its length plus one, without the zero.
        """
        ring, header, table = self.ring, self._header, _CRC
        size, end = len(ring), _HEADER_SIZE + len(data)
        if len(data) + _AROUND > size - self.used:
            return False
        struct.pack_into(_HEADER, header, 0, _VERSION, kind, 0, interface, sequence, now)
        start = at = (self.first + self.used) % size  # start: where the length of the open run will be; at: its end
        crc, run = 0xFFFF, 1
        for index in range(end + 2):
            if index < end:
                byte = header[index] if index < _HEADER_SIZE else data[index - _HEADER_SIZE]
                crc ^= byte << 8
                crc = (crc << 4 & 0xFFFF) ^ table[crc >> 12]
                crc = (crc << 4 & 0xFFFF) ^ table[crc >> 12]
            else:
                byte = crc & 0xFF if index == end else crc >> 8
            at += 1
            if at == size:
                at = 0
            if byte:
                ring[at] = byte
                run += 1
                if run < _LONGEST_RUN:
                    continue
                at += 1  # the run is full: the next length takes a place of its own, not that of a zero
                if at == size:
                    at = 0
            ring[start] = run
            start, run = at, 1
        ring[start] = run
        at = (at + 1) % size
        ring[at] = 0
        self.used = (at + 1 - self.first) % size or size
        return True


class Decoder:
    """A decoder of the host's bytes. After a byte that completes a valid frame, the attributes hold its header."""

    def __init__(self) -> None:
        self.kind = self.interface = self.sequence = 0
        self.data = bytearray(_LIMIT)
        self._length = 0

    def take(self, byte: int) -> bool:
        """True if ``byte`` completes a valid frame of at most 160 bytes and of our version."""
        length = self._length
        if byte:
            if length < _LIMIT:
                self.data[length] = byte
            self._length += length <= _LIMIT  # counts to one more than fits, which shows that it is too long
            return False
        self._length = 0
        return 0 < length <= _LIMIT and self._parse(self._unstuff(length) - 2)

    def _unstuff(self, size: int) -> int:
        """Decode in place; returns the decoded length, 0 if a run exceeds the frame."""
        data = self.data
        source = target = 0
        while source < size:
            code = data[source]  # the length of a run plus one
            after = source + code
            if after > size:
                return 0
            while source + 1 < after:
                source += 1
                data[target] = data[source]
                target += 1
            source = after
            if code < _LONGEST_RUN and source < size:
                data[target] = 0
                target += 1
        return target

    def _parse(self, size: int) -> bool:
        """Check and parse a decoded frame; ``size`` is that of all before the CRC."""
        data = self.data
        if size < _HEADER_SIZE or data[0] != _VERSION:
            return False
        if crc16(data, size) != data[size] | data[size + 1] << 8:
            return False
        _, self.kind, _, self.interface, self.sequence, _ = struct.unpack_from(_HEADER, data, 0)
        return True
