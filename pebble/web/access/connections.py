"""Limits of network connections: how many there may be, and how long each may take for what it sends and reads.

uvicorn has no time limit for the head of a request, and waits without end for a client that reads nothing.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import socket
import threading
from ipaddress import ip_address
from typing import Any, cast

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from pebble.fleet.tries import network_of

log = logging.getLogger(__name__)

MAX_CONNECTIONS = 200
MAX_PEOPLE = 192  # of these by people who have logged in; the rest is for those who come to do so, or to stop a robot
MAX_STRANGERS = 152  # by others, however few people there are
MAX_EACH = 32  # of others from one address that is not of this machine
MAX_PERSON = 64  # of one person; more count as others
ACCEPT = 16  # at once; what the last ones have sent is read before the next ones come
_WAITING = 2048  # to be accepted
HANDSHAKE_S = 10.0  # for TLS
HEAD_S = 10.0  # for the head of a request, from its first byte on
RESPONSE_S = 60.0  # for the rest of the request, and until the response is read
DOWNLOAD_S = 3600.0  # for a film
_DOWNLOAD = re.compile(r"/archive/exports/[^/]+/file").fullmatch
FLUSH_S = 5.0  # for what is still unread when a connection is closed
_MAX_UNREAD = 256 * 1024  # bytes of answers to a client's own pings


class _Accepted(socket.socket):
    """A connection that is counted until it is closed, or has given way."""

    def __init__(self, listener: Listener, address: Any, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._listener: Listener | None = listener
        self.client, self.network = tuple(address[:2]), network_of(address[0])
        self.spoke = False
        self.person: str | None = None  # None: it has not logged in

    def recv(self, *arguments: Any) -> bytes:
        self.spoke = True
        return super().recv(*arguments)

    def recv_into(self, *arguments: Any) -> int:
        self.spoke = True
        return super().recv_into(*arguments)

    def give_way(self) -> None:
        """End it; its protocol notices that, and closes it."""
        self._leave()
        with contextlib.suppress(OSError):  # the other side was faster
            self.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._leave()
        super().close()

    def _leave(self) -> None:
        listener, self._listener = self._listener, None
        if listener is not None:
            listener.left(self)


class Listener(socket.socket):
    """A listening socket with places for people and for others.

    A connection is one of the others until a request on it belongs to a person (:meth:`recognise`). Where there is no
    place for a new one, the oldest of the others gives way, one that has sent nothing first: who opens connections and
    holds them keeps out neither a person nor a stop.
    """

    def __init__(
        self, family: int, limit: int = MAX_CONNECTIONS, each: int = MAX_EACH, strangers: int = MAX_STRANGERS
    ) -> None:
        super().__init__(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)  # asyncio sets TCP_NODELAY only then
        self._limit, self._each, self._strangers = limit, each, strangers
        self._lock = threading.RLock()  # sessions are read on other threads, too
        self._others: dict[Any, _Accepted] = {}  # by address and port, the oldest first
        self._people: dict[Any, _Accepted] = {}
        self.ended = 0

    @property
    def connections(self) -> int:
        return len(self._others) + len(self._people)

    def listen(self, _backlog: int = 0, /) -> None:
        """asyncio accepts as many at once as it asks to let wait; these are two things here."""
        super().listen(_WAITING)

    def accept(self) -> tuple[socket.socket, Any]:
        descriptor, address = self._accept()  # type: ignore[attr-defined]
        accepted = _Accepted(self, address, self.family, self.type, self.proto, fileno=descriptor)
        with self._lock:
            self._make_room(accepted.network, is_local=_is_loopback(address[0]))
            self._others[accepted.client] = accepted
        return accepted, address

    def recognise(self, client: tuple[str, int], person: str) -> None:
        """A request on the connection from this address and port belongs to a person."""
        with self._lock:
            one = self._others.get(tuple(client))
            own = sum(other.person == person for other in self._people.values())
            if one is not None and own < MAX_PERSON and len(self._people) < min(MAX_PEOPLE, self._limit - 1):
                one.person = person
                self._people[one.client] = self._others.pop(one.client)

    def left(self, one: _Accepted) -> None:
        with self._lock:
            for places in (self._others, self._people):
                if places.get(one.client) is one:
                    del places[one.client]

    def _make_room(self, network: str, *, is_local: bool) -> None:
        others = list(self._others.values())
        own = [one for one in others if one.network == network]
        if not is_local and len(own) >= self._each:
            others = own
        elif len(others) < min(self._strangers, self._limit - len(self._people)):
            return
        oldest = next((one for one in others if not one.spoke), others[0])
        oldest.give_way()
        self.ended += 1
        if self.ended & (self.ended - 1) == 0:  # the 1st, 2nd, 4th, 8th …
            log.warning("%d connections ended, the last from %s: too many at once", self.ended, oldest.client[0])


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
