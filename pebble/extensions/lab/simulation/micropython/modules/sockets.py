"""The network of a simulated board: real, non-blocking TCP of this machine behind a simulated Wi-Fi, and servers."""

from __future__ import annotations

import errno
import select
import socket
import ssl
import time
from collections import deque
from contextlib import suppress
from types import SimpleNamespace
from typing import Any, Final

from pebble.extensions.lab.simulation.micropython.answers import name_answer, time_answer
from pebble.extensions.lab.simulation.micropython.clock import Clock
from pebble.extensions.lab.simulation.micropython.faults import WouldHang, failure
from pebble.extensions.lab.simulation.micropython.modules.streams import POLLERR, POLLHUP, POLLIN, POLLOUT, Stream
from pebble.extensions.lab.simulation.micropython.modules.tls import as_on_a_board, ssl_module
from pebble.extensions.lab.simulation.micropython.modules.wlan import ADDRESS, Platform, Radio, network_module

Address = tuple[str, int]

TIME_HOST: Final = "pool.ntp.org"
_TIME_ADDRESS: Final = "10.0.0.123"
_NAME_SERVERS: Final = ((ADDRESS[3], 53), ("224.0.0.251", 5353))  # RFC 6762: the second for names that end in .local
_MOST = 16  # addresses in an answer, which has 512 bytes at most (RFC 1035, 2.3.4)
_LATER = (BlockingIOError, ssl.SSLWantReadError, ssl.SSLWantWriteError)
MAX_SOCKETS = 5  # TCP connections of the ESP8266's lwIP; the ESP32 has a few more

_CONSTANTS = {name: int(getattr(socket, name)) for name in ("AF_INET", "SOCK_STREAM", "SOCK_DGRAM")}


class HostNetwork:
    """The network of one board, with a name server, which asks this machine's resolver, and a time server.

    The program that runs the board watches ``new_sockets``. If ``unread`` it runs the next turn at once: the last read
    was as long as asked, so there may be more.
    """

    def __init__(self, clock: Clock, *, platform: Platform = "esp32") -> None:
        self.clock = clock
        self.radio = Radio(clock.now, platform)
        self.new_sockets: list[socket.socket] = []  # this machine's, for TCP, until that program has taken them
        self.unread = False
        self.problem = ""  # of the last connection, as text
        self.open: list[BoardSocket] = []  # all that the firmware has not closed
        self._addresses: dict[str, list[str]] = {TIME_HOST: [_TIME_ADDRESS]}  # by name

    def modules(self) -> dict[str, Any]:
        """Close all sockets and turn the radio off, as each boot does; return the modules for the board."""
        self.power_off()
        return {
            "network": network_module(self.radio),
            "socket": socket_module(self._socket),
            "ssl": ssl_module(),
        }

    def power_off(self) -> None:
        """Close all sockets and turn the radio off."""
        for sock in list(self.open):
            sock.close()
        self.radio.activate(False)

    def answer(self, request: bytes, place: Address) -> bytes | None:
        """Return a server's answer to a packet for ``place``; None if nothing answers there."""
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

    def make(self, kind: int) -> BoardSocket:
        """Return a new socket of this kind."""
        return HostTcp(self) if kind == socket.SOCK_STREAM else HostUdp(self)

    def _socket(self, kind: int) -> BoardSocket:
        if len(self.open) >= MAX_SOCKETS:
            raise OSError(errno.ENFILE, "too many sockets: one is not closed")
        self.open.append(self.make(kind))
        return self.open[-1]


def socket_module(make: Any) -> SimpleNamespace:
    """Return the module ``socket`` of one board; ``make`` opens a socket of the given type.

    It has no getaddrinfo, which blocks a real board for seconds.
    """

    def open_socket(_family: int = socket.AF_INET, kind: int = socket.SOCK_STREAM, _protocol: int = 0) -> Any:
        return make(kind)

    return SimpleNamespace(socket=open_socket, **_CONSTANTS)


def numeric(address: Address) -> Address:
    """Return ``address`` if it is numeric. Raises OSError for a name, which would need a resolver."""
    try:
        socket.inet_pton(socket.AF_INET, address[0])
    except OSError:
        raise OSError(-2, f"{address[0]} is not an address") from None
    return address


class BoardSocket:
    """The base class of all sockets: they never block, and receive nothing without Wi-Fi."""

    def __init__(self, network: Any) -> None:
        self._network = network

    def setblocking(self, blocking: bool) -> None:
        if blocking:
            raise WouldHang("a socket that waits: setblocking(False)")

    def close(self) -> None:
        if self in self._network.open:
            self._network.open.remove(self)

    def _need_wifi(self) -> None:
        if not self._network.radio.connected:
            raise failure(errno.EHOSTUNREACH)


class HostTcp(BoardSocket, Stream):
    """A TCP connection of the board."""

    def __init__(self, network: HostNetwork) -> None:
        super().__init__(network)
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._sock.setblocking(False)
        self._poll = select.poll()
        self._poll.register(self._sock, 0)  # `ready` sets the events
        self._established = False
        network.new_sockets.append(self._sock)  # which the program that runs the board watches

    def close(self) -> None:
        super().close()
        self._sock.close()

    def ready(self, mask: int) -> int:
        """Return the events in ``mask`` that are present, for the board's poll()."""
        if self._sock.fileno() < 0:
            return 32  # POLLNVAL
        if not self._network.radio.connected:
            return 0
        self._poll.modify(self._sock, mask & (POLLIN | POLLOUT))
        events = self._poll.poll(0)
        return events[0][1] & (mask | POLLERR | POLLHUP) if events else 0

    def connect(self, address: Address) -> None:
        """Start to connect. Raises OSError in any case: EINPROGRESS on success."""
        self._need_wifi()
        code = self._sock.connect_ex(numeric(address))
        raise failure(code or errno.EINPROGRESS)

    def secure(self, context: ssl.SSLContext, server_hostname: str | None) -> None:
        """Add TLS to the connection, at the same file descriptor."""
        self._sock = context.wrap_socket(self._sock, server_hostname=server_hostname, do_handshake_on_connect=False)

    def _receive(self, size: int) -> bytes | None:
        """Return up to ``size`` bytes, b"" at the connection's end, None if nothing has come or there is no Wi-Fi."""
        if not self._network.radio.connected:
            return None
        try:
            chunk = self._sock.recv(size)
            self._network.problem = "" if chunk else "the broker closed the connection"
        except _LATER:
            chunk = None
        except OSError as error:
            self._network.problem = error.strerror or str(error)
            if isinstance(error, ssl.SSLError):
                raise as_on_a_board(error) from None
            raise error from None
        self._network.unread = chunk is not None and len(chunk) == size  # there may be more: see HostNetwork
        return chunk

    def _send(self, data: bytes) -> int | None:
        if not self._network.radio.connected:
            return None
        if not self._established and not self.ready(POLLOUT):
            # Before the connection is there, an ESP32 refuses data by an error, an ESP8266 does not. No data is sent.
            if self._network.radio.platform == "esp32":
                raise failure(errno.EINPROGRESS)
            return None
        self._established = True
        try:
            return self._sock.send(data)
        except _LATER:
            return None
        except ssl.SSLError as error:
            raise as_on_a_board(error) from None


class HostUdp(BoardSocket):
    """A UDP socket of the board, which reaches the servers of its network only."""

    def __init__(self, network: HostNetwork) -> None:
        super().__init__(network)
        self._answers: deque[tuple[bytes, Address]] = deque()

    def sendto(self, data: bytes, address: Address) -> int:
        self._need_wifi()
        if (answer := self._network.answer(bytes(data), numeric(address))) is not None:
            self._answers.append((answer, address))
        return len(data)

    def recvfrom(self, size: int) -> tuple[bytes, Address]:
        if not self._answers or not self._network.radio.connected:
            raise failure(errno.EAGAIN)
        data, address = self._answers.popleft()
        return data[:size], address
