"""A DNS server and an SNTP server on loopback UDP, for simulated boards with real sockets."""

from __future__ import annotations

import socket
import threading
import time
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


class HostResolver:
    """Resolves names by this machine's resolver without blocking: a later query gets an answer that is not ready."""

    def __init__(self) -> None:
        self._known: dict[str, list[str] | None] = {TIME_HOST: [_TIME_ADDRESS]}
        self._asking: set[str] = set()

    def known(self, name: str) -> bool:
        """Whether ``name`` is resolved, even if it does not exist; otherwise starts to resolve it."""
        if name in self._known:
            return True
        if name not in self._asking:
            self._asking.add(name)
            threading.Thread(target=self._ask, args=(name,), name=f"look up {name}", daemon=True).start()
        return False

    def addresses(self, name: str) -> list[str] | None:
        found = self._known.get(name)
        if found is None:
            self._known.pop(name, None)  # it may exist at the next query
        return found

    def _ask(self, name: str) -> None:
        try:
            found = socket.getaddrinfo(name, None, socket.AF_INET, socket.SOCK_STREAM)
            self._known[name] = list(dict.fromkeys(str(one[4][0]) for one in found))[:_MOST]
        except OSError:
            self._known[name] = None
        self._asking.discard(name)


class LoopbackServers:
    """Both servers. ``routes`` is for HostNetwork; the scheduler calls ``serve`` when one of ``sockets`` is readable.

    ``names`` and ``clock`` = False switch a server off, as without an uplink.
    """

    def __init__(self) -> None:
        self.names = self.clock = True
        self._hosts = HostResolver()
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
            answer = self._time(request) if sock is self._servers[_NTP] else self._name(request)
            if answer is not None:
                sock.sendto(answer, asker)

    def close(self) -> None:
        for sock in self.sockets:
            sock.close()

    def _time(self, request: bytes) -> bytes | None:
        return time_answer(request, time.time()) if self.clock else None

    def _name(self, query: bytes) -> bytes | None:
        if not self.names:
            return None
        unresolved = []

        def addresses_of(name: str) -> list[str] | None:
            unresolved.append(not self._hosts.known(name))
            return self._hosts.addresses(name)

        answer = name_answer(query, addresses_of)
        return None if any(unresolved) else answer


def _server() -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", 0))
    sock.setblocking(False)
    return sock
