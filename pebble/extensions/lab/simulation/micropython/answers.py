"""Replies of a DNS server and of an SNTP server to a board's packets. Pure: bytes in, bytes out."""

import socket
import struct
from collections.abc import Callable, Sequence

NO_SUCH_NAME = 3  # RFC 1035, 4.1.1

_SINCE_1900_S = 2_208_988_800  # of the Unix epoch, in the era of NTP
_A, _IN, _ANSWER = 1, 1, 0x8180  # a host address; the internet; an answer, recursion desired and available
_TTL_S = 60


def name_answer(query: bytes, addresses_of: Callable[[str], str | Sequence[str] | None]) -> bytes | None:
    """Return the reply to a DNS query for IPv4 addresses, one or several; None for other packets (RFC 1035, 4.1)."""
    try:
        name, end = _name(query, 12)
        kind, class_ = struct.unpack_from("!HH", query, end)
    except (IndexError, struct.error, UnicodeDecodeError):
        return None
    is_query = len(query) >= 12 and not query[2] & 0x80
    if not is_query or kind != _A or class_ & 0x7FFF != _IN:  # the top bit of the class: mDNS, by unicast
        return None
    addresses = addresses_of(name)
    question = query[12 : end + 4]
    if addresses is None:
        return query[:2] + struct.pack("!HHHHH", _ANSWER | NO_SUCH_NAME, 1, 0, 0, 0) + question
    head = struct.pack("!HHHIH", 0xC00C, _A, _IN, _TTL_S, 4)
    listed = [addresses] if isinstance(addresses, str) else addresses
    records = [head + socket.inet_aton(address) for address in listed]
    return query[:2] + struct.pack("!HHHHH", _ANSWER, 1, len(records), 0, 0) + question + b"".join(records)


def time_answer(request: bytes, epoch_s: float) -> bytes | None:
    """Return the reply of a stratum 2 server to an SNTP request; None for other packets (RFC 4330, 4)."""
    if len(request) < 48 or request[0] & 7 != 3:
        return None
    stamp = struct.pack("!II", *_stamp(epoch_s))
    head = struct.pack("!BBbbII4s", (request[0] & 0x38) | 4, 2, 6, -20, 0, 0, b"SIM\0")
    return head + stamp + request[40:48] + stamp + stamp


def _stamp(epoch_s: float) -> tuple[int, int]:
    seconds = int(epoch_s)
    return (seconds + _SINCE_1900_S) & 0xFFFFFFFF, int((epoch_s - seconds) * (1 << 32))


def _name(packet: bytes, at: int) -> tuple[str, int]:
    """Return the dotted name that starts at ``at``, in lower case, and the place after it."""
    labels = []
    while length := packet[at]:
        labels.append(packet[at + 1 : at + 1 + length].decode("ascii").lower())
        at += 1 + length
    return ".".join(labels), at + 1
