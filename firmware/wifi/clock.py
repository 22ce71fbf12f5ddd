"""The time of day on a board without a clock, from a time server, without blocking. A driver."""

import random

from micropython import const

from common.ticks import add, diff
from wifi import sntp
from wifi.sockets import Query, query_name

_WAIT_MS = const(900)  # half of the round trip is added; for longer ones that would be too inaccurate
_LOOKUP_MS = const(3500)
_RETRY_MS = const(10_000)
_AGAIN_MS = const(3_600_000)  # a crystal that is 20 ppm off loses 72 ms in an hour


class Clock:
    """A clock. Call ``step`` every turn; ``read`` returns epoch ms, or ms since boot until a server has answered."""

    def __init__(self, host: str, now: int) -> None:
        """Store the arguments; ``host`` is the time server; "": none."""
        self.host = host
        self._wall = sntp.WallClock(now)
        self.read = self._wall.read
        self._open: Query | None = None  # the DNS query for the server's name, then the request to the server
        self._nonce: bytes | None = None  # of the request for the time; None during the DNS query
        self._due = now  # the next query, or since when the present one waits

    def step(self, now: int, server: str) -> None:
        """Continue a request. ``server`` is the DNS server; "": there is no network. Failures are retried later."""
        if not server or not self.host:
            self._close(now)
            return
        try:
            self._ask(now, diff(now, self._due), server)
        except (OSError, ValueError):  # no socket; no name
            self._close(add(now, _RETRY_MS))

    def _ask(self, now: int, age: int, server: str) -> None:
        """Look up the server's name, then request the time from it.

        ``age``: ms since the present query was due, the lookup or the request; below 0: it is not due yet.
        """
        if not self._open:
            if age >= 0:
                self._due = now
                self._open = query_name(self.host, server, now)
        elif self._nonce:
            epoch = sntp.epoch_ms(self._open.step(now), self._nonce)
            if epoch is not None:
                self._wall.set(epoch + age // 2, now)  # the answer took half of the round trip
                self._close(add(now, _AGAIN_MS))
            elif age >= _WAIT_MS:
                self._close(add(now, _RETRY_MS))
        else:
            address = self._open.address(now)
            if address:
                self._close(now)
                self._nonce = random.getrandbits(32).to_bytes(4, "big") * 2  # 8 bytes, from 32 bits at most
                self._open = Query(address, 123, sntp.request(self._nonce), now)
            elif address is not None or age >= _LOOKUP_MS:  # "": the name has no address
                self._close(add(now, _RETRY_MS))

    def _close(self, due: int) -> None:
        """Close the socket, and open none before the time ``due``."""
        self.read(due)  # regularly, because ticks wrap
        self._due = due
        if self._open:
            self._open.socket.close()
        self._open = self._nonce = None
