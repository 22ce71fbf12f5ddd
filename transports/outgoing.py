"""How much of what was accepted is still on its way: for streams that would rather send less than late."""

from __future__ import annotations

import fcntl
import socket
import struct
import sys
import termios
from contextlib import suppress
from dataclasses import dataclass

_TCP_INFO = getattr(socket, "TCP_INFO", None)  # Linux only
_MIN_RTT = struct.Struct("@I")  # of struct tcp_info (linux/tcp.h, since 4.5): tcpi_min_rtt, microseconds
_MIN_RTT_AT = 148
_NEVER = 0xFFFFFFFF  # no round trip was measured yet


@dataclass(frozen=True, slots=True)
class Outgoing:
    """A transport that cannot tell says zero, as one does that has nothing on its way."""

    waiting: int = 0  # bytes that the other machine has not confirmed; some overhead of the protocols included
    round_trip_s: float = 0.0  # the shortest of this connection: what waits for no longer is merely travelling


def unconfirmed(sock: socket.socket) -> int:
    """Bytes the kernel has taken and the other side's TCP has not confirmed: sent or not (SIOCOUTQ)."""
    size = bytearray(4)
    with suppress(OSError, ValueError):  # closed, or no TCP
        fcntl.ioctl(sock.fileno(), termios.TIOCOUTQ, size)
    return int.from_bytes(size, sys.byteorder)


def shortest_round_trip_s(sock: socket.socket) -> float:
    """The kernel's own measurement of the last minutes; 0 where it has none."""
    if _TCP_INFO is None:
        return 0.0
    info = b""
    with suppress(OSError, ValueError):
        info = sock.getsockopt(socket.IPPROTO_TCP, _TCP_INFO, _MIN_RTT_AT + _MIN_RTT.size)
    if len(info) < _MIN_RTT_AT + _MIN_RTT.size:
        return 0.0
    (microseconds,) = _MIN_RTT.unpack_from(info, _MIN_RTT_AT)
    return 0.0 if microseconds == _NEVER else microseconds / 1e6
