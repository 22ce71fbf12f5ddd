"""The time of day: requests to a time server and its answers (SNTP, RFC 4330), and the clock they set. Pure."""

import struct

from micropython import const

from common.ticks import diff

_TO_UNIX_S = const(2208988800)  # from 1900, where NTP counts from, to 1970
_ERA_S = const(1 << 32)  # NTP's seconds start again in 2036


def request(nonce: bytes) -> bytes:
    """Return a 48-byte client request, version 4. The answer repeats its 8 random bytes; a forger cannot."""
    return b"\x23" + bytes(39) + nonce


def epoch_ms(packet: bytes, nonce: bytes) -> int | None:
    """Return the time at which the server sent ``packet``, in epoch ms; None if it does not answer our request."""
    if len(packet) < 48 or packet[24:32] != nonce:
        return None
    first, stratum = packet[0], packet[1]
    if first & 7 != 4 or first >> 6 == 3 or not 0 < stratum < 16:  # no server, clock not set, kiss of death
        return None
    seconds, fraction = struct.unpack_from(">II", packet, 40)
    if not seconds:
        return None
    if not seconds >> 31:  # so few are of the era that begins in 2036
        seconds += _ERA_S
    return (seconds - _TO_UNIX_S) * 1000 + (fraction * 1000 >> 32)


class WallClock:
    """The time of day. Before the first ``set`` it counts from 0, which readers take for an unknown time.

    Call ``read`` at least once in six days, because ticks wrap.
    """

    def __init__(self, now: int) -> None:
        self._epoch_ms = 0
        self._at = now

    def set(self, epoch_ms: int, now: int) -> None:
        """Set the time to ``epoch_ms`` at tick ``now``."""
        self._epoch_ms = epoch_ms
        self._at = now

    def read(self, now: int) -> int:
        self._epoch_ms += diff(now, self._at)
        self._at = now
        return self._epoch_ms
