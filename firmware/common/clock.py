"""The time of day on a board without a clock: asks a time server now and then, without waiting. A driver."""

import random

from micropython import const

from common import sntp
from common.sockets import Question, ask_name
from common.ticks import add, diff
from common.wall import Wall

_WAIT_MS = const(900)  # half of the way there and back is added: of more than this, half would be a guess
_LOOKUP_MS = const(3500)
_RETRY_MS = const(10_000)
_AGAIN_MS = const(3_600_000)  # a crystal that is 20 ppm off loses 72 ms in an hour


class Clock:
    """``step`` every turn; ``read`` gives epoch milliseconds, or those since boot until a server answered."""

    def __init__(self, host: str, now: int) -> None:
        """``host`` "": nobody is asked."""
        self._host = host
        self._wall = Wall(now)
        self.read = self._wall.read
        self._open: Question | None = None  # a server's name being looked up; with a nonce, the server being asked
        self._nonce: bytes | None = None
        self._due = now

    def step(self, now: int, server: str) -> None:
        """``server`` knows names; "": there is no network. What fails is tried again later."""
        if not server or not self._host:
            self._close(now)
            return
        try:
            self._ask(now, diff(now, self._due), server)
        except (OSError, ValueError):  # no socket; no name
            self._close(add(now, _RETRY_MS))

    def _ask(self, now: int, age: int, server: str) -> None:
        if not self._open:
            if age >= 0:
                self._due = now
                self._open = ask_name(self._host, server, now)
        elif self._nonce:
            told = sntp.epoch_ms(self._open.step(now), self._nonce)
            if told is not None:
                self._wall.set(told + age // 2, now)
                self._close(add(now, _AGAIN_MS))
            elif age >= _WAIT_MS:
                self._close(add(now, _RETRY_MS))
        else:
            address = self._open.address(now)
            if address:
                self._close(now)
                self._nonce = random.getrandbits(32).to_bytes(4, "big") * 2
                self._open = Question(address, 123, sntp.request(self._nonce), now)
            elif address is not None or age >= _LOOKUP_MS:
                self._close(add(now, _RETRY_MS))

    def _close(self, due: int) -> None:
        """Nothing is open until ``due``; once it is, ``_due`` is when that began."""
        self.read(due)  # now and then, or it loses count
        self._due = due
        if self._open:
            self._open.socket.close()
        self._open = self._nonce = None
