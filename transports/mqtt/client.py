"""A client of an MQTT broker for one connection: its socket, the bytes that wait to be written, and message ids.

It has neither a lock nor a thread: the connection has both. One `recv` takes everything that has come, and one `send`
writes a message, or all acknowledgements of what was read.
"""

import socket
import ssl
import time
from collections import deque
from collections.abc import Iterable
from contextlib import closing, suppress
from typing import NamedTuple

from pebble.transports.base import Message
from pebble.transports.hosts import CONNECT_TIMEOUT_S, HANDSHAKE_S, Address, dial
from pebble.transports.mqtt import packets
from pebble.transports.mqtt.ending import alert
from pebble.transports.mqtt.packets import MOST_IDS, Filter, Listener, Reader, SendQuota
from pebble.transports.mqtt.poll import SocketPoll
from pebble.transports.settings import MqttSettings

SEND_BUFFER = 64 * 1024  # bytes in the kernel for a slow connection: with its default a stream would lag by minutes
_PIECE = 64 * 1024  # bytes that are read at once
_ENDING_S = 0.2  # after DISCONNECT
_NOTSENT_LOWAT = getattr(socket, "TCP_NOTSENT_LOWAT", None)
_NOT_NOW = (BlockingIOError, ssl.SSLWantReadError, ssl.SSLWantWriteError)


class Opening(NamedTuple):
    """Parameters for opening a connection."""

    client_id: str
    settings: MqttSettings
    context: ssl.SSLContext | None  # None: without TLS
    will: Message | None
    address: Address  # one of the host's; TLS checks the name of the host
    patience_s: float = CONNECT_TIMEOUT_S  # seconds for which TLS may be silent


def is_hang_up(error: OSError | None) -> bool:
    """True if the other side has closed the connection, by FIN (None) or RST; False if the network has failed."""
    return error is None or isinstance(error, ConnectionError | ssl.SSLEOFError)


class TlsLateError(TimeoutError):
    """An error: the TLS handshake takes too long."""


def begin_tls(plain: socket.socket, opening: Opening) -> ssl.SSLSocket:
    """Return a non-blocking socket with TLS that takes over ``plain``. Raises OSError; a failed handshake closes it."""
    assert opening.context is not None  # noqa: S101 - else there is no TLS
    name = opening.settings.host.partition("%")[0]  # without the network card of an address: fe80::1%eth0
    sock = opening.context.wrap_socket(plain, server_hostname=name, do_handshake_on_connect=False)
    try:
        sock.setblocking(False)
        _shake_hands(sock, opening.patience_s)
    except BaseException:
        sock.close()
        raise
    return sock


def _shake_hands(sock: ssl.SSLSocket, patience_s: float) -> None:
    """Do the TLS handshake, within HANDSHAKE_S and without a silence of ``patience_s``. Raises OSError."""
    end = time.monotonic() + HANDSHAKE_S
    with closing(SocketPoll()) as poll:
        poll.register(sock)
        while True:
            try:
                sock.do_handshake()
            except _NOT_NOW as blocked:
                wait_s = min(patience_s, end - time.monotonic())
                if wait_s <= 0 or not any(poll.wait(wait_s, write=isinstance(blocked, ssl.SSLWantWriteError))):
                    raise TlsLateError("the TLS handshake does not go on") from None
            else:
                return


def keep_unsent(sock: socket.socket, size: int) -> None:
    """Let the kernel accept only about ``size`` bytes beyond those on their way, if supported; 0: its default."""
    if _NOTSENT_LOWAT is not None:
        with suppress(OSError):  # it may be closed already
            sock.setsockopt(socket.IPPROTO_TCP, _NOTSENT_LOWAT, size)


def _mark(sock: socket.socket, dscp: int) -> None:
    """Mark our packets for routers that forward marked packets first, if the system permits it."""
    level, option = socket.IPPROTO_IP, socket.IP_TOS
    if sock.family == socket.AF_INET6:
        level, option = socket.IPPROTO_IPV6, socket.IPV6_TCLASS
    with suppress(OSError):
        sock.setsockopt(level, option, dscp << 2)


class Client:
    """The client of one connection. `open` waits, all else returns at once; `read` calls ``listener``."""

    def __init__(self, opening: Opening, listener: Listener, *, bridge: bool) -> None:
        settings = opening.settings
        self.socket: socket.socket | None = None  # None: not open yet, or lost
        self.unwritten = 0  # bytes that the kernel has not accepted yet
        self.drained = True  # `receive` has emptied the socket
        self.hung_up = False  # the other side has ended the connection, in whatever way
        self.failure: OSError | None = None  # why there is nothing more to read, if not because of a FIN
        self.waiting: deque[bytes] = deque()  # to be written, once the socket accepts more
        self._modern = settings.protocol == "5"
        self._opening = opening
        self._hello = packets.connect(
            opening.client_id,
            modern=self._modern,
            bridge=bridge,
            keepalive_s=settings.keepalive_s,
            will=opening.will,
            username=settings.username,
            password=settings.password,
        )
        self._mid = 0  # the newest message id
        self._quota = SendQuota(self._send)
        self._reader = Reader(listener, self._quota, modern=self._modern)

    def open(self) -> None:
        """Connect, and send CONNECT. Raises OSError; ValueError for a host that cannot be a name."""
        opening = self._opening
        sock = dial(opening.address, max_segment=opening.settings.max_segment)
        try:
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
            if opening.settings.dscp:
                _mark(sock, opening.settings.dscp)
            if opening.context is not None:
                sock = begin_tls(sock, opening)
            sock.setblocking(False)
        except BaseException:
            sock.close()
            raise
        self.socket = sock
        self._send(self._hello)

    def close(self) -> None:
        """Close the socket without DISCONNECT."""
        if self.socket is not None:
            with suppress(OSError):
                self.socket.close()
        self.socket = None

    # -- reading

    def receive(self) -> int:
        """Take bytes out of the socket; return their number. Call this when `read` has left no bytes unread.

        If the other side has closed the connection, `socket` is None afterwards.
        """
        sock, self.drained = self.socket, True  # unless bytes come
        if sock is None:
            return 0
        try:
            data, error = sock.recv(_PIECE), None
        except _NOT_NOW:
            return 0
        except OSError as failure:
            data, error = b"", failure
        if not data:
            self.hung_up, self.failure = is_hang_up(error), error
            self.close()
        # Fewer bytes than asked for: the socket has no more. With TLS their number does not tell that.
        self.drained = not data or (len(data) < _PIECE and self._opening.context is None)
        self._reader.feed(data)
        return len(data)

    def read(self, most: int) -> int:
        """Give up to ``most`` packets to the listener; return how many bytes are left. Raises MalformedError."""
        reader = self._reader
        reader.read(most)
        return reader.unread

    @property
    def owes(self) -> bool:
        """True if messages were read that are not acknowledged."""
        return bool(self._reader.acks)

    def acknowledge(self) -> None:
        """Send the acknowledgements of all messages read, in one piece. Call this after the messages were handled."""
        reader = self._reader
        acks, reader.acks = bytes(reader.acks), bytearray()
        self._send(acks)

    # -- writing

    def write(self) -> None:
        """Write the waiting bytes, as far as the socket accepts them."""
        waiting, self.waiting, self.unwritten = self.waiting, deque(), 0
        for data in waiting:
            self._send(data)  # all the others wait after the first one that is not accepted

    def publish(self, topic: str, payload: bytes, qos: int, *, retain: bool, expires_s: int | None) -> int:
        """Send a PUBLISH; return its message id, 0 with QoS 0."""
        mid = 0
        if qos:
            mid = self._mid = self._mid % MOST_IDS + 1
        packet = packets.publish(topic, payload, qos, mid, retain=retain, modern=self._modern, expires_s=expires_s)
        if not qos or self._quota.takes(packet):  # else the quota keeps it, to send it later
            self._send(packet)
        return mid

    def subscribe(self, filters: Iterable[Filter]) -> int:
        """Send a SUBSCRIBE; return its message id."""
        mid = self._next_id()
        self._send(packets.subscribe(mid, filters, modern=self._modern))
        return mid

    def unsubscribe(self, filters: Iterable[str]) -> int:
        mid = self._next_id()
        self._send(packets.unsubscribe(mid, filters, modern=self._modern))
        return mid

    def ping(self) -> None:
        self._send(packets.PINGREQ)

    def disconnect(self) -> None:
        """Send DISCONNECT, and close the socket in a way that lets it arrive.

        A connection with unread data is reset when it is closed, and a proxy then resets the broker's, which may lose
        the DISCONNECT. So bytes that come until the broker closes it, or for `_ENDING_S`, are read and thrown away.
        """
        self._send(packets.DISCONNECT)
        if self.waiting:  # the socket accepts no more: the connection is discarded without DISCONNECT
            return
        if self.socket is not None:
            with suppress(OSError, ValueError):  # the broker's side sends nothing more, or has ended the connection
                self.socket.shutdown(socket.SHUT_WR)
                self.socket.settimeout(_ENDING_S)
                end = time.monotonic() + _ENDING_S  # also for a broker that goes on sending
                while self.socket.recv(_PIECE) and time.monotonic() < end:
                    pass
        self.close()

    def _fail(self, error: OSError) -> None:
        """Close the socket, as a write has failed. The other side's reason, an alert of TLS, may be readable still."""
        if self.socket is not None and self._opening.context is not None:
            try:
                self.socket.recv(1)
            except OSError as reason:
                error = reason if alert(reason) else error
        self.hung_up, self.failure = is_hang_up(error), error
        self.close()

    def _next_id(self) -> int:
        self._mid = self._mid % MOST_IDS + 1
        return self._mid

    def _send(self, data: bytes) -> None:
        """Send bytes, or let them wait behind earlier ones. Must be fast."""
        if self.socket is None:
            return
        if not self.waiting:
            try:
                written = self.socket.send(data)
            except _NOT_NOW:
                written = 0
            except OSError as error:
                self._fail(error)
                return
            if written == len(data):
                return
            data = data[written:]
        self.waiting.append(data)
        self.unwritten += len(data)
