"""A DNS server and an SNTP server on loopback, for simulated boards with real sockets."""

from __future__ import annotations

import socket
import time
from contextlib import suppress
from typing import Final

from pebble.extensions.lab.simulation.micropython.answers import name_answer, time_answer
from pebble.extensions.lab.simulation.micropython.modules.sockets import Address
from pebble.extensions.lab.simulation.micropython.modules.wlan import ADDRESS

TIME_HOST: Final = "pool.ntp.org"
_TIME_ADDRESS: Final = "10.0.0.123"
_DNS: Final[Address] = (ADDRESS[3], 53)
_MDNS: Final[Address] = ("224.0.0.251", 5353)  # RFC 6762: names that end in .local
_NTP: Final[Address] = (_TIME_ADDRESS, 123)
_LONGEST = 1500
_MOST = 16  # addresses in an answer, which has 512 bytes at most (RFC 1035, 2.3.4)


class LoopbackServers:
    """A DNS and an SNTP server. ``routes`` is for HostNetwork; call ``serve`` when one of ``sockets`` is readable."""

    def __init__(self) -> None:
        self._addresses: dict[str, list[str]] = {TIME_HOST: [_TIME_ADDRESS]}  # of names that are known
        self._servers = {place: _server() for place in (_DNS, _MDNS, _NTP)}
        self.sockets = tuple(self._servers.values())
        self.routes: dict[Address, Address] = {place: sock.getsockname() for place, sock in self._servers.items()}

    def serve(self, sock: socket.socket) -> None:
        """Answer all requests at this socket."""
        while True:
            try:
                request, asker = sock.recvfrom(_LONGEST)
            except BlockingIOError:
                return
            if sock is self._servers[_NTP]:
                answer = time_answer(request, time.time())
            else:
                answer = name_answer(request, self._resolve)
            if answer is not None:
                sock.sendto(answer, asker)

    def close(self) -> None:
        for sock in self.sockets:
            sock.close()

    def _resolve(self, name: str) -> list[str] | None:
        """Return the addresses of a name by this machine's resolver; None if there is none at present."""
        if name not in self._addresses:
            with suppress(OSError):
                answers = socket.getaddrinfo(name, None, socket.AF_INET, socket.SOCK_STREAM)
                self._addresses[name] = list(dict.fromkeys(str(address[4][0]) for address in answers))[:_MOST]
        return self._addresses.get(name)


def _server() -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", 0))
    sock.setblocking(False)
    return sock
