"""A topic that the node publishes, and its subscribers. What a subscriber cannot take now is dropped, never late."""

from __future__ import annotations

import logging
import socket
import threading
import time
from collections.abc import Callable

from pebble.services.ros1_bridge.messages import Form
from pebble.services.ros1_bridge.wire import MOST_HEADER, Blocks, block

log = logging.getLogger(__name__)

MOST_PEERS = 8  # connections of one topic, in each direction
BLOCKED_S = 1.0  # a subscriber that takes nothing for so long is disconnected
_UNACKED_S = 0.5  # what is not acknowledged for so long is thrown away with its connection: it is true no longer
_SEND_BUFFER = 2048  # bytes: what waits in the kernel is old


class Subscriber:
    """A connection from another node, which first sends its request."""

    def __init__(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(1000 * _UNACKED_S))
        self.sock, self.name = sock, "?"  # until its request names it
        self.publication: Publication | None = None  # None: it has not said yet what it wants
        self.blocks = Blocks(MOST_HEADER)
        self._unsent = b""  # the end of a block that was sent in part, and has to be completed
        self._blocked_from: float | None = None  # since when it takes nothing; None: it has taken the last block

    def send(self, data: bytes) -> bool:
        """Send a block at once, or drop it and return False. Raises OSError if the connection is broken."""
        now = time.monotonic()
        try:
            if self._unsent:
                self._unsent = self._unsent[self.sock.send(self._unsent) :]
            if not self._unsent:
                self._unsent = data[self.sock.send(data) :]
                self._blocked_from = None
                return True
        except BlockingIOError:
            pass
        self._blocked_from = self._blocked_from or now
        if now - self._blocked_from > BLOCKED_S:
            raise TimeoutError("it takes nothing")
        return False


class Publication:
    """A topic of ROS. :meth:`send` may be called on any thread; ``close`` is how a connection is closed."""

    def __init__(self, topic: str, form: Form, definition: str, close: Callable[[socket.socket], None]) -> None:
        self.topic, self.form, self.definition = topic, form, definition
        #: Returns the message that a new subscriber gets at once, made at that moment; None: it gets none.
        self.first: Callable[[], bytes | None] = lambda: None
        self.dropped = 0
        self._close = close
        self._lock = threading.Lock()
        self._subscribers: list[Subscriber] = []

    @property
    def names(self) -> set[str]:
        """Names of the nodes that are connected."""
        with self._lock:
            return {subscriber.name for subscriber in self._subscribers}

    def send(self, body: bytes) -> int:
        """Send a message to all subscribers that can take it now; return their number."""
        data = block(body)
        with self._lock:
            return sum([self._send(subscriber, data) for subscriber in list(self._subscribers)])

    def add(self, subscriber: Subscriber) -> bool:
        """Add a subscriber whose request was answered; send it what `first` returns. False if there are too many."""
        with self._lock:
            if len(self._subscribers) >= MOST_PEERS:
                return False
            subscriber.publication = self
            self._subscribers.append(subscriber)
            body = self.first()
            if body is not None:
                self._send(subscriber, block(body))
        log.info("%s: %s subscribes", self.topic, subscriber.name)
        return True

    def remove(self, subscriber: Subscriber, why: str) -> None:
        """Disconnect a subscriber."""
        with self._lock:
            self._remove(subscriber, why)

    def remove_all(self, why: str) -> None:
        with self._lock:
            for subscriber in list(self._subscribers):
                self._remove(subscriber, why)

    def finish(self) -> None:
        """Let messages on their way arrive, and send no more."""
        with self._lock:
            for subscriber in self._subscribers:
                try:
                    subscriber.sock.shutdown(socket.SHUT_WR)
                except OSError:
                    log.debug("%s: %s is gone already", self.topic, subscriber.name)

    def _send(self, subscriber: Subscriber, data: bytes) -> bool:
        """Send to one subscriber; False if it cannot take the message now, which is then dropped, or is gone."""
        try:
            was_sent = subscriber.send(data)
        except OSError as error:
            self._remove(subscriber, str(error))
            return False
        if not was_sent:
            self.dropped += 1
        return was_sent

    def _remove(self, subscriber: Subscriber, why: str) -> None:
        if subscriber in self._subscribers:
            self._subscribers.remove(subscriber)
            log.warning("%s: %s is gone: %s", self.topic, subscriber.name, why)
        self._close(subscriber.sock)
