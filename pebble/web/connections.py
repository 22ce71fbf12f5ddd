"""Limits of network connections: how many there may be, and how long each may take for what it sends and reads.

uvicorn has no time limit for the head of a request, and waits without end for a client that reads nothing.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import socket
from collections import Counter
from ipaddress import ip_address
from typing import Any, cast

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from pebble.fleet.tries import network_of

log = logging.getLogger(__name__)

MAX_CONNECTIONS = 200
MAX_EACH = 32  # from one address that is not of this machine
HANDSHAKE_S = 10.0  # for TLS
HEAD_S = 10.0  # for the head of a request, from its first byte on
RESPONSE_S = 60.0  # for the rest of the request, and until the response is read
DOWNLOAD_S = 3600.0  # for a film
_DOWNLOAD = re.compile(r"/archive/exports/[^/]+/file").fullmatch
FLUSH_S = 5.0  # for what is still unread when a connection is closed
_MAX_UNREAD = 256 * 1024  # bytes of answers to a client's own pings


class _Accepted(socket.socket):
    """A connection that is counted until it is closed."""

    def __init__(self, listener: Listener, network: str, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._listener: Listener | None = listener
        self._network = network

    def close(self) -> None:
        listener, self._listener = self._listener, None
        if listener is not None:
            listener.closed(self._network)
        super().close()


class Listener(socket.socket):
    """A listening socket that refuses connections beyond the limits: before TLS, which costs time."""

    def __init__(self, family: int, limit: int = MAX_CONNECTIONS, each: int = MAX_EACH) -> None:
        super().__init__(family, socket.SOCK_STREAM)
        self._limit, self._each = limit, each
        self._open: Counter[str] = Counter()
        self.refused = 0

    @property
    def connections(self) -> int:
        return self._open.total()

    def accept(self) -> tuple[socket.socket, Any]:
        """Raises ConnectionAbortedError for a connection beyond the limits, which asyncio ignores."""
        descriptor, address = self._accept()  # type: ignore[attr-defined]
        network = network_of(address[0])
        if self.connections >= self._limit or (self._open[network] >= self._each and not _is_loopback(address[0])):
            socket.close(descriptor)
            self.refused += 1
            if self.refused & (self.refused - 1) == 0:  # the 1st, 2nd, 4th, 8th …
                log.warning("%d connections refused, the last from %s: too many at once", self.refused, address[0])
            raise ConnectionAbortedError
        self._open[network] += 1
        accepted = _Accepted(self, network, self.family, self.type, self.proto, fileno=descriptor)
        return accepted, address

    def closed(self, network: str) -> None:
        self._open[network] -= 1
        if not self._open[network]:
            del self._open[network]


class Loop(asyncio.SelectorEventLoop):
    """Gives TLS less time than asyncio's minute. A selector on Windows, too, so that a Listener counts there."""

    async def create_server(self, *arguments: Any, **options: Any) -> asyncio.Server:
        if options.get("ssl"):
            options.setdefault("ssl_handshake_timeout", HANDSHAKE_S)
        return await super().create_server(*arguments, **options)


class HttpProtocol(H11Protocol):
    """Aborts a connection whose request or response takes too long."""

    _deadline: asyncio.TimerHandle | None = None
    _seconds = 0.0  # of the deadline that runs

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._limit(HEAD_S)

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if self.transport.get_protocol() is not self:  # a WebSocket now
            self._unlimit()
        elif self.transport.is_closing():
            _abort_later(self.transport)
        else:
            self._limit(HEAD_S if self.conn.their_state is h11.IDLE else self._response_s())

    def connection_lost(self, exc: Exception | None) -> None:
        self._unlimit()
        super().connection_lost(exc)

    def on_response_complete(self) -> None:
        self._unlimit()
        super().on_response_complete()
        if self.transport.is_closing():
            _abort_later(self.transport)
        elif self.conn.their_state is not h11.IDLE:  # the rest of a body, or the next request
            self._limit(RESPONSE_S)

    def timeout_keep_alive_handler(self) -> None:
        super().timeout_keep_alive_handler()
        _abort_later(self.transport)

    def _response_s(self) -> float:
        path = self.scope.get("path", "") if self.scope else ""
        return DOWNLOAD_S if _DOWNLOAD(path) else RESPONSE_S

    def _limit(self, seconds: float) -> None:
        """The same limit does not begin anew, or a byte per second would do."""
        if seconds != self._seconds:
            self._unlimit()
            self._seconds = seconds
            self._deadline = self.loop.call_later(seconds, _abort, self.transport)

    def _unlimit(self) -> None:
        self._seconds = 0.0
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None


class WebSocketProtocol(WebSocketsSansIOProtocol):
    """Aborts a connection that does not read."""

    def handle_ping(self) -> None:
        super().handle_ping()
        if self.transport.get_write_buffer_size() > _MAX_UNREAD:
            _abort(self.transport)

    def keepalive_timeout(self) -> None:
        super().keepalive_timeout()
        _abort(self.transport)

    def on_task_complete(self, task: asyncio.Task[None]) -> None:
        super().on_task_complete(task)
        _abort_later(self.transport)


def _abort_later(transport: asyncio.Transport) -> None:
    """A transport that is closed sends the rest first, for as long as the client likes."""
    asyncio.get_running_loop().call_later(FLUSH_S, _abort, transport)


def _abort(transport: asyncio.BaseTransport) -> None:
    """Close it without waiting. Python 3.11's TLS transport raises if its connection has ended already."""
    with contextlib.suppress(AttributeError):
        cast(asyncio.Transport, transport).abort()


def _is_loopback(address: str) -> bool:
    try:
        return ip_address(address.partition("%")[0]).is_loopback
    except ValueError:
        return False
