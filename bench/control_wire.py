"""Messages of the control comparison: a number, three time stamps, and padding to the requested size. Pure."""

from __future__ import annotations

import struct
from typing import NamedTuple

_FORM = struct.Struct("<Qqqq")
_ECHOED = struct.Struct("<qq")
_ECHOED_AT = 16  # behind the number and the first stamp
SMALLEST = _FORM.size


class Exchange(NamedTuple):
    """NTP's four stamps in ns. Near clock: t1 (sent) and t4 (received). Far clock: t2 (received) and t3 (sent)."""

    t1: int
    t2: int
    t3: int
    t4: int
    transport_ns: int = 0  # before t4: when the near transport received it


def request(number: int, t1: int, size: int) -> bytes:
    return _FORM.pack(number, t1, 0, 0).ljust(size, b"\0")


def stamped(payload: bytes, t2: int, t3: int) -> bytes:
    """The same message with the echo's stamps, of the same length. Raises struct.error for a foreign message."""
    message = bytearray(payload)
    _ECHOED.pack_into(message, _ECHOED_AT, t2, t3)
    return bytes(message)


def parse(payload: bytes) -> tuple[int, int, int, int]:
    """Number, t1, t2, t3. Raises struct.error for a foreign message."""
    number, t1, t2, t3 = _FORM.unpack_from(payload)
    return number, t1, t2, t3
