"""A TCP connection, and queries by UDP, all non-blocking. A driver.

MicroPython's streams: ``readinto`` and ``write`` return None when they would block, and ``connect`` raises EINPROGRESS
(docs.micropython.org, library/socket and library/io). Addresses are numeric, so that no port looks up a name.
"""

import errno
import random
import select
import socket

from micropython import const

from common.ticks import diff
from wifi import dns

_AGAIN_MS = const(1000)
_DATAGRAM = const(512)  # more than any answer needed here (RFC 1035 section 2.3.4)


class Stream:
    """A TCP connection. It is usable once ``ready``; every failure is an OSError."""

    def __init__(self, host: str, port: int, wrap) -> None:
        """Start to connect; ``wrap`` puts TLS around the connected socket; None: no TLS."""
        self.wrap = wrap
        self._tried = 0  # bytes of a write that must be repeated; 0: none
        self._poll: select.poll | None = select.poll()
        self.socket = socket.socket()
        try:
            self.socket.setblocking(False)
            self.socket.connect((host, port))
        except OSError as error:
            if error.errno != errno.EINPROGRESS:
                self.socket.close()
                raise
        self._poll.register(self.socket, select.POLLOUT)

    def ready(self) -> bool:
        """True if the connection is made."""
        if self._poll:
            if not self._poll.poll(0):
                return False
            self._poll = None  # if it failed, reading and writing raise the error
            if self.wrap:
                self.socket = self.wrap(self.socket)
        return True

    def read(self, data: memoryview) -> int:
        """Return how many bytes were received. Raises OSError at the end of the stream."""
        count = self.socket.readinto(data)
        if count == 0:
            raise OSError("closed by the broker")
        return count or 0

    def write(self, data: memoryview, count: int) -> int:
        """Return how many of the first ``count`` bytes were sent; pass the rest again, unchanged.

        TLS may have encrypted what it could not send yet, and then needs exactly the same bytes again (Mbed TLS,
        mbedtls_ssl_write): so the same number of bytes is repeated.
        """
        count = self._tried or count
        gone = self.socket.write(data[:count])
        self._tried = 0 if gone else count
        return gone or 0


class Query:
    """A query by UDP: it sends a datagram every second, and receives answers from its destination only."""

    def __init__(self, host: str, port: int, data: bytes, now: int, skip: int = 0) -> None:
        self.host = host
        self._port = port
        self.data = data
        self._skip = skip  # see query_name
        self._due = now
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)

    def step(self, now: int) -> bytes:
        """Return the next answer, b"" if there is none. A multicast query (224.x.x.x) may be answered by any host."""
        try:
            if diff(now, self._due) >= 0:
                self._due = now + _AGAIN_MS
                self.socket.sendto(self.data, (self.host, self._port))
            data, (host, port) = self.socket.recvfrom(_DATAGRAM)  # type: ignore[misc, str-unpack]  # no str
        except OSError:  # no data; or no route, which counts as a lost packet
            return b""
        return data if port == self._port and (host == self.host or self.host.startswith("224.")) else b""

    def address(self, now: int) -> str | None:
        """Return the address of the queried name; "" if there is none, None if it is not known yet."""
        return dns.answer(self.step(now), self.data, self._skip) if self.data else self.host


def query_name(host: str, server: str, now: int, skip: int = 0) -> Query:
    """Return a query for the address of ``host``, at ``server`` or by mDNS for .local; for an address it sends nothing.

    ``skip``: which of several addresses, see `dns.answer`.
    """
    if host.replace(".", "").isdigit():
        return Query(host, 0, b"", now)
    data = dns.query(host, random.getrandbits(16).to_bytes(2, "big"))
    if host.endswith(".local"):
        return Query("224.0.0.251", 5353, data, now, skip)
    return Query(server, 53, data, now, skip)
