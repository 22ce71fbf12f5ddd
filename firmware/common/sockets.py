"""A TCP connection, and questions by UDP: none of them ever waits. A driver.

MicroPython's streams: ``readinto`` and ``write`` return None when they would block, and ``connect`` raises EINPROGRESS
(docs.micropython.org, library/socket and library/io). Addresses are numbers, so that no port looks a name up.
"""

import errno
import random
import select
import socket

from micropython import const

from common import dns
from common.ticks import diff

_AGAIN_MS = const(1000)
_DATAGRAM = const(512)  # more than any answer needed here (RFC 1035 section 2.3.4)


class Stream:
    """Opens at once, is ``ready`` later; every trouble is an OSError."""

    def __init__(self, host: str, port: int, wrap) -> None:
        """``wrap`` puts TLS around the connected socket; None: none."""
        self._wrap = wrap
        self._tried = 0
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
        """Is the connection made?"""
        if self._poll:
            if not self._poll.poll(0):
                return False
            self._poll = None  # if it failed, reading and writing say how
            if self._wrap:
                self.socket = self._wrap(self.socket)
        return True

    def read(self, data: memoryview) -> int:
        """How many bytes came; at the end of the stream an OSError."""
        count = self.socket.readinto(data)
        if count == 0:
            raise OSError("closed by the broker")
        return count or 0

    def write(self, data: memoryview, count: int) -> int:
        """How many of the first ``count`` bytes went; the rest has to come again, unchanged.

        TLS may have taken in what it could not send yet, and then wants the very same bytes, no more (Mbed TLS,
        mbedtls_ssl_write): they are repeated as they were.
        """
        count = self._tried or count
        gone = self.socket.write(data[:count])
        self._tried = 0 if gone else count
        return gone or 0


class Question:
    """One datagram out, once a second, and the answers from where it went."""

    def __init__(self, host: str, port: int, data: bytes, now: int) -> None:
        self._host = host
        self._port = port
        self.data = data
        self._due = now
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)

    def step(self, now: int) -> bytes:
        """The next answer, b"" if there is none. To a group (224.x.x.x) everybody may answer."""
        try:
            if diff(now, self._due) >= 0:
                self._due = now + _AGAIN_MS
                self.socket.sendto(self.data, (self._host, self._port))
            data, (host, port) = self.socket.recvfrom(_DATAGRAM)  # type: ignore[misc, str-unpack]  # no str
        except OSError:  # nothing there; or no way out, which is as good as lost on the way
            return b""
        return data if port == self._port and (host == self._host or self._host.startswith("224.")) else b""

    def address(self, now: int) -> str | None:
        """If a name was asked for, its address; "" if there is none; None: not known yet."""
        return dns.answer(self.step(now), self.data) if self.data else self._host


def ask_name(host: str, server: str, now: int) -> Question:
    """For the address of ``host``: DNS of ``server``, or mDNS for names in .local; numbers are not asked for."""
    if host.replace(".", "").isdigit():
        return Question(host, 0, b"", now)
    data = dns.query(host, random.getrandbits(16).to_bytes(2, "big"))
    return Question("224.0.0.251", 5353, data, now) if host.endswith(".local") else Question(server, 53, data, now)
