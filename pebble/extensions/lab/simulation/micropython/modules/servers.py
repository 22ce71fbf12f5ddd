"""The name server and the time server in the network of a simulated board."""

import socket
import time
from contextlib import suppress
from typing import Final

from pebble.extensions.lab.simulation.micropython.answers import name_answer, time_answer
from pebble.extensions.lab.simulation.micropython.modules.wlan import ADDRESS

Address = tuple[str, int]

TIME_HOST: Final = "pool.ntp.org"
_TIME_ADDRESS: Final = "10.0.0.123"
_NAME_SERVERS: Final = ((ADDRESS[3], 53), ("224.0.0.251", 5353))  # RFC 6762: the second for names that end in .local
_MOST = 16  # addresses in an answer, which has 512 bytes at most (RFC 1035, 2.3.4)


class Servers:
    """The servers. A name has the addresses that this machine's resolver returns."""

    def __init__(self) -> None:
        self._addresses: dict[str, list[str]] = {TIME_HOST: [_TIME_ADDRESS]}  # of names that are known

    def answer(self, request: bytes, place: Address) -> bytes | None:
        """Return the answer to a packet for ``place``; None if nothing answers there."""
        if place == (_TIME_ADDRESS, 123):
            return time_answer(request, time.time())
        return name_answer(request, self._resolve) if place in _NAME_SERVERS else None

    def _resolve(self, name: str) -> list[str] | None:
        """Return the addresses of a name; None if there is none at present."""
        if name not in self._addresses:
            with suppress(OSError):
                answers = socket.getaddrinfo(name, None, socket.AF_INET, socket.SOCK_STREAM)
                self._addresses[name] = list(dict.fromkeys(str(address[4][0]) for address in answers))[:_MOST]
        return self._addresses.get(name)
