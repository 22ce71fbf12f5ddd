"""Asking a time server once (SNTP, RFC 4330): bytes out, bytes in. Pure."""

import struct

_TO_UNIX_S = 2208988800  # from 1900, where NTP counts from, to 1970
_ERA_S = 1 << 32  # NTP's seconds start again in 2036


def request(nonce: bytes) -> bytes:
    """48 bytes: version 4, client; the 8 random bytes come back in the answer and tell it from a forged one."""
    return b"\x23" + bytes(39) + nonce


def epoch_ms(packet: bytes, nonce: bytes) -> int | None:
    """When the server sent ``packet``, in epoch milliseconds; None if it is no good answer to our request."""
    if len(packet) < 48 or packet[24:32] != nonce:
        return None
    first, stratum = packet[0], packet[1]
    if first & 7 != 4 or first >> 6 == 3 or not 0 < stratum < 16:  # no server, clock not set, kiss of death
        return None
    seconds, fraction = struct.unpack_from(">II", packet, 40)
    if not seconds:
        return None
    if not seconds >> 31:
        seconds += _ERA_S
    return (seconds - _TO_UNIX_S) * 1000 + (fraction * 1000 >> 32)
