"""One connection to an MQTT broker, from CONNECT to its loss.

It is discarded as a whole, so that nothing in a client library's queue can outlive a disconnect (T4, T19). paho has no
thread of its own here: one network thread calls `pump`, any thread calls `publish`. One lock guards paho, which does
not support two writing threads (nor does OpenSSL support reading and writing at once). It is not held while a handler
runs.
"""

from __future__ import annotations

import logging
import random
import select
import socket
import ssl
import struct
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from math import ceil, inf
from typing import Any, cast

import paho.mqtt.client as paho
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode, MQTTProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode
from paho.mqtt.subscribeoptions import SubscribeOptions

from pebble.transports import clock
from pebble.transports.base import Message, Outgoing, QoS
from pebble.transports.counters import Counters
from pebble.transports.mqtt.bridge_mode import Result
from pebble.transports.mqtt.incoming import BrokerDelay, WaitingTime, readable_bytes
from pebble.transports.mqtt.outgoing import (
    Backlog,
    InFlightTable,
    PendingAck,
    present_round_trip_s,
    shortest_round_trip_s,
    unconfirmed_bytes,
)
from pebble.transports.settings import MqttSettings

log = logging.getLogger(__name__)

CONNECT_TIMEOUT_S = 2.0  # for TCP and TLS, and again for the broker's CONNACK (T12)
_HESITATION_S = 0.5  # a CONNACK that takes longer comes over a very slow connection, or from a suspended broker
UNACKED_LIMIT = 1000  # DELIVERED messages the broker has not acknowledged; beyond it they are refused
MAX_PACKET = 1024 * 1024  # bytes; a longer one is read and discarded
_HEAD = 2 + 65_535 + 2  # bytes of a PUBLISH up to its message id, at most
_OVERHEAD = 1 + 4 + 2 + 2 + 1 + 5  # bytes of a PUBLISH besides topic and payload, at most: with an expiry
_PIECE = 64 * 1024  # bytes of a long packet that are read at once
SEND_BUFFER = 64 * 1024  # bytes in the kernel for a slow connection: with its default a stream would lag by minutes
_CLEAR = 8 * 1024  # bytes ahead of a ping that do not delay it much
_LEAST_PING_S = 0.05  # between two pings, however short the allowed silence
_LEAST_SHARE = 0.75  # of the interval between pings: answers to regular ones could not be told apart
_OVERSLEPT_S = 0.1  # poll took so much longer than asked for: the process was stopped, or the machine suspended
_BATCH = 64  # messages read in a row before they are delivered
_RETAIN, _ANY_QOS, _QOS_2 = 0b1, 0b110, 0b100  # in the first byte of a PUBLISH
_NO_TOPIC = 2  # where a PUBLISH goes on that has a topic alias (MQTT 5), or is malformed
_QUICKACK = getattr(socket, "TCP_QUICKACK", None)  # Linux only
_ABORT = struct.pack("ii", 1, 0)  # SO_LINGER that makes close() drop what was not sent


class Lost(Exception):  # noqa: N818  (an event, not a mistake)
    """The connection was lost, or could not be made. Its text explains why."""


class Silent(Lost):
    """The other side does not answer."""


class Refused(Lost):
    """The broker refused our CONNECT, or closed the connection instead of answering."""

    def __init__(self, text: str, result: Result = Result.FAILED) -> None:
        super().__init__(text)
        self.result = result


class _Poll:
    """Waits until ``sock`` is readable or has an error, or (with ``write``) writable, or ``wake`` is readable."""

    def __init__(self, sock: int, wake: int, *, write: bool) -> None:
        self._sock, self._wake, self._write = sock, wake, write
        self._poll = select.poll() if hasattr(select, "poll") else None  # Windows has none
        if self._poll is not None:
            self._poll.register(sock, select.POLLIN | (select.POLLOUT if write else 0))
            self._poll.register(wake, select.POLLIN)

    def wait(self, seconds: float) -> tuple[bool, bool, bool]:
        """Which of the three: readable, writable, woken."""
        if self._poll is None:
            return self._select(seconds)
        events = dict(self._poll.poll(ceil(seconds * 1000)))
        seen = events.get(self._sock, 0)
        return bool(seen & ~select.POLLOUT), bool(seen & select.POLLOUT), bool(events.get(self._wake))

    def _select(self, seconds: float) -> tuple[bool, bool, bool]:
        try:
            ready = select.select([self._sock, self._wake], [self._sock] if self._write else [], [self._sock], seconds)
        except (OSError, ValueError):  # closed meanwhile: reading it says so
            return True, False, False
        return self._sock in ready[0] + ready[2], bool(ready[1]), self._wake in ready[0]


def ignore(_messages: list[Message]) -> None:
    """Discard messages: for :meth:`Connection.pump` before a connection is accepted, and at its end."""


class _Client(paho.Client):
    """paho, with pings of our own (its keepalive is too slow for T19), a limit, and the sizes of what waits."""

    on_pong: Callable[[], None]
    on_too_long: Callable[[bytes, int], None]  # with the topic of a PUBLISH, and the length of the packet
    on_publication: Callable[[bytes, bytes, int], None]  # topic, payload and first byte of a PUBLISH, without paho
    skips: Callable[[bytes], bool]  # whether a retained message of this topic is not wanted
    received = 0  # bytes of the packets so far
    _ahead, _ahead_at = b"", 0  # read from the socket in one go, and how much of that paho has had
    protocol_refused = False  # by return code 1 of a CONNACK on MQTT 3.1.1

    @property
    def unwritten(self) -> int:
        """Bytes that the kernel has not accepted yet."""
        return sum(packet["to_process"] for packet in self._out_packet)

    @property
    def unread(self) -> int:
        """Bytes that were taken out of the socket, and not read yet."""
        return len(self._ahead) - self._ahead_at

    def ping(self) -> None:
        self._send_pingreq()

    def _sock_recv(self, bufsize: int) -> bytes:
        if self._too_long:
            del self._in_packet["packet"][_HEAD:]
            bufsize = min(bufsize, _PIECE)
        begin = self._ahead_at
        if begin == len(self._ahead) and bufsize >= _PIECE:
            data = super()._sock_recv(bufsize)
        else:  # paho reads a packet in three pieces or more: take many packets out of the socket at once
            if begin == len(self._ahead):
                self._ahead, begin = super()._sock_recv(_PIECE), 0
            data = self._ahead[begin : begin + bufsize]
            self._ahead_at = begin + len(data)
        self.received += len(data)
        return data

    @property
    def _too_long(self) -> bool:
        """Whether the packet that arrives is discarded, but for its head."""
        return bool(self._in_packet["have_remaining"]) and self._in_packet["remaining_length"] > MAX_PACKET

    def _handle_publish(self) -> MQTTErrorCode:
        """Read a PUBLISH without paho's objects, unless it has properties (MQTT 5) or QoS 2, or is malformed. Hot."""
        packet, first = self._in_packet["packet"], self._in_packet["command"]
        too_long = self._too_long
        end = 2 + int.from_bytes(packet[:2])
        start = end + 2 if first & _ANY_QOS else end
        if too_long:
            self.on_too_long(bytes(packet[2:end]), self._in_packet["remaining_length"])
        elif not (first & _RETAIN and self._skips_retained(packet, end, start)):
            if self._protocol == MQTTProtocolVersion.MQTTv5:
                start += 1  # the length of the properties
                plain = start <= len(packet) and packet[start - 1] == 0
            else:
                plain = start <= len(packet)
            if not plain or first & _QOS_2 or end == _NO_TOPIC:
                return super()._handle_publish()
            self.on_publication(bytes(packet[2:end]), bytes(packet[start:]), first)
        if not first & _ANY_QOS:
            return MQTTErrorCode.MQTT_ERR_SUCCESS
        return self._send_puback(int.from_bytes(packet[end : end + 2]))

    def _skips_retained(self, packet: bytearray, end: int, start: int) -> bool:
        """Whether the retained PUBLISH that arrived, whose topic ends at ``end``, is not wanted. Removals are."""
        if self._protocol == MQTTProtocolVersion.MQTTv5 and start < len(packet):
            start += 1 + packet[start]  # of properties, of which nobody needs 128 bytes
        return len(packet) > start and self.skips(bytes(packet[2:end]))

    def _handle_on_message(self, message: paho.MQTTMessage) -> None:
        """Without paho's search for callbacks by topic."""
        if self.on_message is not None:
            self.on_message(self, None, message)

    def _handle_connack(self) -> MQTTErrorCode:
        self.protocol_refused = self._in_packet["packet"][1:2] == b"\1"
        return super()._handle_connack()

    def _handle_pingresp(self) -> MQTTErrorCode:
        self.on_pong()
        return super()._handle_pingresp()


class Connection:
    """One connection: a paho client, the backlog of its socket, and the acknowledgements that the broker owes.

    `as_published` uses bridge mode on 3.1.1, and noLocal and retain-as-published on 5 (T7, T16). `on_answers` is called
    on the network thread with the filters that the broker has answered, and whether it refused each (T21).
    """

    def __init__(
        self,
        client_id: str,
        settings: MqttSettings,
        context: ssl.SSLContext | None,
        will: Message | None,
        counters: Counters,
        *,
        as_published: bool,
        on_answers: Callable[[Mapping[str, bool]], None],
        skips_retained: Callable[[bytes], bool],
    ) -> None:
        self.as_published = as_published
        self.dialling = True  # connect(2) or a TLS handshake may be blocking, and cannot be interrupted
        self.hesitated = False  # the broker took so long to accept us that it may have been suspended
        self.where = f"broker {settings.host}:{settings.port}"
        self.max_packet: int | None = None  # bytes, as the broker says on MQTT 5
        #: When there was the last sign that the answers are behind retained messages, or behind a long one.
        self.arriving_at = float("-inf")
        self._settings, self._counters = settings, counters
        self._modern = settings.protocol == "5"
        self._lock = threading.RLock()
        self._inbox: list[Message] = []
        self._on_answers, self._skips_retained = on_answers, skips_retained
        self._asked: dict[int, list[str]] = {}  # the filters of each SUBSCRIBE without an answer, by message id
        self._answers: dict[str, bool] = {}  # filters answered since the last `on_answers`: refused?
        self._backlog = Backlog()
        self._in_flight = InFlightTable()
        self._answered_at = clock.since_boot()
        self._waiting = WaitingTime(self._answered_at)
        self._delay = BrokerDelay()
        self._since = self._answered_at  # of the batch that is read
        self._ping_share = 1.0  # of the interval until the next ping
        self._pinged_at = self._answered_at  # pings are sent regularly: other answers come only to what we publish
        self._packets = 0  # received so far
        self._more = False  # a batch ended before the socket was empty
        self._accepted = False
        self._refusal = self._disconnect_reason = ""
        self._wake_read, self._wake_write = socket.socketpair()
        self._wake_read.setblocking(False)
        self._wake_write.setblocking(False)
        self._client = self._make_client(client_id, context, will)

    # -- opening and closing

    def connect(self, stopping: threading.Event) -> None:
        """Connect and wait for the broker's CONNACK, or for ``stopping``; raises Lost."""
        try:
            self._client.connect(self._settings.host, self._settings.port, self._settings.keepalive_s)
        except (OSError, ValueError) as error:
            raise Lost(f"{self.where} cannot be reached: {error}") from None
        self.dialling = False
        self._answered_at = clock.since_boot()
        deadline = time.monotonic() + CONNECT_TIMEOUT_S
        try:
            while not self._accepted:
                if stopping.is_set():
                    raise Lost("closed")
                if time.monotonic() > deadline:
                    raise Silent(f"{self.where} accepts connections but does not speak MQTT in time")
                self.pump(deadline - time.monotonic(), ignore)
        except Refused:
            raise
        except Lost as lost:
            if self._socket() is None:
                raise Refused(f"{self.where} hung up on our CONNECT", Result.HUNG_UP) from None
            raise lost from None

    def discard(self) -> None:
        """Reset the connection without DISCONNECT; all queued data is lost, in the kernel too."""
        with self._lock:
            sock = self._socket()
            if sock is not None:
                with suppress(OSError):  # it may be closed already
                    sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _ABORT)
                sock.close()
            self._wake_read.close()
            self._wake_write.close()
            self._in_flight.end()

    def disconnect(self) -> None:
        """Send DISCONNECT: the broker then discards our will."""
        with self._lock:
            self._client.disconnect()
            self._client.loop_write()

    def wake(self) -> None:
        """Make `pump` return; for other threads."""
        with suppress(OSError):  # full of wake-ups already, or discarded
            self._wake_write.send(b"\0")

    # -- the network thread

    def pump(self, timeout: float, receive: Callable[[list[Message]], None]) -> None:
        """Wait up to ``timeout`` seconds for the socket, read and write, and deliver what was received. Raises Lost.

        A `PendingAck` is completed after ``receive`` was given the messages that came before the answer: a retained
        message is never delivered later than the confirmation of its subscription. Whether a subscription is refused is
        known before both.
        """
        readable = self._wait(timeout)
        with self._lock:
            # Before reading: messages queued during a silence must not arrive as if they were fresh (T19).
            self._check_silence()
            if readable or self._more:
                self._read()
            self._write()
            if self._accepted and self._ping_due_in() <= 0:
                self._ping()
            self._quick_ack()
            messages, self._inbox = self._inbox, []
            answers, self._answers = self._answers, {}
        if answers:
            self._on_answers(answers)
        receive(messages)
        self._note_copies(messages)  # again: they may take longer to handle than an answer may
        self._in_flight.complete()

    def _wait(self, timeout: float) -> bool:
        with self._lock:
            sock = self._socket()
            if sock is None:
                raise Lost(self._disconnect_reason or f"{self.where} closed the connection")
            blocked = self._client.want_write()
            poll = _Poll(sock.fileno(), self._wake_read.fileno(), write=blocked)
            wait = min(timeout, self._ping_due_in())
        began = clock.since_boot()
        readable, writable, woken = poll.wait(0.0)
        if not (readable or writable or woken or self._more):
            self._waiting.empty(began)
            readable, writable, woken = poll.wait(max(wait, 0.0))
            if (now := clock.since_boot()) - began <= wait + _OVERSLEPT_S:
                self._waiting.empty(now)  # until just now
        if woken:
            self._wake_read.recv(4096)
        if writable:
            self._answered_at = clock.since_boot()  # the other side's TCP accepted some: slow, but alive
        if readable:
            self._waiting.found(readable_bytes(sock) + self._client.unread, clock.since_boot())
        return readable

    def _check_silence(self) -> None:
        if not self._accepted:
            return  # `connect` has its own deadline, and gives the first round trip
        limit, now = self._silence_limit_s, clock.since_boot()
        if now - max(self._answered_at, self.arriving_at) > limit:
            self._counters.add("silences")
            raise Silent(f"{self.where} has not answered for {limit:.1f} s")

    @property
    def _silence_limit_s(self) -> float:
        return max(self._settings.silence_s, 4 * _LEAST_PING_S, 4 * self._in_flight.round_trip_s)

    @property
    def _waiting_since(self) -> float:
        """Since when what is read now may have waited, here or at the broker."""
        now, sock = clock.since_boot(), self._socket()
        waited = self._delay.seconds(now, lambda: 0.0 if sock is None else present_round_trip_s(sock))
        return min(self._waiting.since, now - waited) if waited > 0 else self._waiting.since

    def _note_copies(self, messages: list[Message]) -> None:
        if any(message.retain for message in messages):
            self.arriving_at = clock.since_boot()

    def _read(self) -> None:
        began, size = clock.since_boot(), self._client.received
        self._since = self._waiting_since
        received = before = self._packets
        while True:
            self._read_some()
            if self._packets == before or self._packets - received >= _BATCH:
                break
            before = self._packets
        if self._packets == received:
            self.arriving_at = clock.since_boot()  # a piece of a long message
        self._note_copies(self._inbox)
        sock = self._socket()
        buffered = isinstance(sock, ssl.SSLSocket) and sock.pending() > 0
        self._more = buffered or self._client.unread > 0 or self._packets - received >= _BATCH
        self._waiting.read(self._client.received - size)
        if not self._more:
            self._waiting.empty(began)

    def _read_some(self) -> None:
        failed = self._client.loop_read()
        if self._refusal:
            raise Refused(self._refusal)
        if failed and self._client.protocol_refused:
            raise Refused(f"{self.where} refused us: {Result.PROTOCOL_REFUSED.value}", Result.PROTOCOL_REFUSED)
        if failed:
            raise Lost(f"{self.where} closed the connection")

    def _write(self) -> None:
        if self._client.want_write():
            self._client.loop_write()
        while self._backlog and self._socket() is not None and not self._client.want_write():
            self._write_publish(self._backlog.take(), None)

    def _socket(self) -> socket.socket | None:
        return cast("socket.socket | None", self._client.socket())

    def _quick_ack(self) -> None:
        """Send TCP's ACKs at once: a broker with Nagle's algorithm delays its next message until then (up to 40 ms).

        The kernel falls back to delayed ACKs whenever we send, so this is called after every read and write.
        """
        sock = self._socket()
        if _QUICKACK is not None and sock is not None:
            with suppress(OSError):  # the other side has just gone
                sock.setsockopt(socket.IPPROTO_TCP, _QUICKACK, 1)

    # -- ping

    def ping(self) -> PendingAck:
        """Send a ping: its answer proves that the broker has processed everything sent before."""
        ack = PendingAck()
        with self._lock:
            self._ping(ack)
        return ack

    def _ping(self, ack: PendingAck | None = None) -> None:
        sock = self._socket()
        ahead = self._client.unwritten + (0 if sock is None else unconfirmed_bytes(sock))
        self._pinged_at = now = clock.since_boot()
        self._ping_share = random.uniform(_LEAST_SHARE, 1.0)  # noqa: S311  (no secret)
        self._in_flight.ping(now, ack)
        self._delay.asked(now, clear=ahead <= _CLEAR)
        self._client.ping()
        self._client.loop_write()

    def _ping_due_in(self) -> float:
        keepalive_s = self._settings.keepalive_s or inf  # 0: none
        interval = max(_LEAST_PING_S, min(self._settings.silence_s, keepalive_s) / 4)
        return self._pinged_at + interval * self._ping_share - clock.since_boot()

    def _on_pong(self) -> None:
        self._note_answer()
        self._in_flight.pong(self._answered_at)
        self._delay.answered(self._answered_at)

    # -- any thread

    def publish(self, message: Message, *, expires_s: int | None = None) -> bool:
        """Send a message; False if that is impossible. A LATEST one may wait, and be dropped for a newer one."""
        with self._lock:
            if self._socket() is None:
                return False
            if message.qos is QoS.DELIVERED and self._in_flight.unacked >= UNACKED_LIMIT:
                return False
            self._in_flight.accept(message)
            if message.qos is QoS.LATEST and self._client.want_write():
                self._counters.add("dropped", self._backlog.put(message))
            else:
                if self._backlog:
                    self._counters.add("dropped", self._backlog.supersede(message))
                self._write_publish(message, expires_s)
                self._quick_ack()
            blocked = self._socket() is None or self._client.want_write()
        if blocked:
            self.wake()
        return True

    def takes(self, message: Message) -> bool:
        """Whether the broker has not said that ``message`` is too large."""
        size = _OVERHEAD + len(message.topic.encode()) + len(message.payload)
        return self.max_packet is None or size <= self.max_packet

    def _write_publish(self, message: Message, expires_s: int | None) -> None:
        properties = None
        if self._modern and expires_s is not None:
            properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
            properties.MessageExpiryInterval = expires_s
        sent = self._client.publish(message.topic, message.payload, int(message.qos), message.retain, properties)
        self._in_flight.sent(message, sent.mid, clock.since_boot())
        self._client.loop_write()

    def subscribe(self, filters: Iterable[tuple[str, bool]], qos: QoS = QoS.DELIVERED) -> PendingAck:
        """Subscribe to filters, each with its noLocal option (MQTT 5 only)."""
        topics: list[Any]
        asked, most = list(filters), min(int(qos), self._settings.max_qos)
        if self._modern:
            handling = SubscribeOptions.RETAIN_SEND_ON_SUBSCRIBE
            if not self._settings.sends_retained:
                handling = SubscribeOptions.RETAIN_DO_NOT_SEND
            topics = [
                (filter_, SubscribeOptions(most, no_local, self.as_published, handling)) for filter_, no_local in asked
            ]
        else:
            topics = [(filter_, most) for filter_, _ in asked]
        return self._request(self._client.subscribe, topics, [filter_ for filter_, _ in asked])

    def unsubscribe(self, filters: list[str]) -> PendingAck:
        return self._request(self._client.unsubscribe, filters, [])

    def _request(
        self, send: Callable[[Any], tuple[MQTTErrorCode, int | None]], topics: list[Any], asked: list[str]
    ) -> PendingAck:
        ack = PendingAck()
        if not topics:
            ack.complete()
            return ack
        with self._lock:
            failed, mid = send(topics)
            if failed or mid is None:
                ack.complete()
            else:
                self._in_flight.ask(mid, ack)
                self._asked[mid] = asked
                self._client.loop_write()
        self.wake()
        return ack

    # -- state

    @property
    def has_room(self) -> bool:
        return self._in_flight.unacked < UNACKED_LIMIT // 2

    @property
    def drained(self) -> bool:
        """Whether everything accepted is written, and acknowledged where that is due."""
        with self._lock:
            return not (self._in_flight.unacked or self._backlog or self._client.want_write())

    @property
    def unacked(self) -> int:
        return self._in_flight.unacked

    @property
    def outgoing(self) -> Outgoing:
        with self._lock:
            sock = self._socket()
            if sock is None:
                return Outgoing()
            waiting = self._backlog.size + self._client.unwritten + unconfirmed_bytes(sock)
            round_trip_s, since = shortest_round_trip_s(sock), self._in_flight.waiting_since
            # TCP may end before the broker; and brokers without TCP_NODELAY send an answer after that to the one before
            usual_s = 2 * max(round_trip_s, self._in_flight.round_trip_s)
            stalled_s = 0.0 if since is None else max(0.0, clock.since_boot() - since - usual_s)
            return Outgoing(waiting, round_trip_s, stalled_s)

    def unconfirmed_retained(self) -> list[Message]:
        """Retained messages that the broker may not have received, oldest first."""
        with self._lock:
            return self._in_flight.unconfirmed_retained()

    # -- paho's callbacks: on the network thread, with the lock held

    def _make_client(self, client_id: str, context: ssl.SSLContext | None, will: Message | None) -> _Client:
        protocol = MQTTProtocolVersion.MQTTv5 if self._modern else MQTTProtocolVersion.MQTTv311
        client = _Client(
            CallbackAPIVersion.VERSION2, client_id=client_id, protocol=protocol, reconnect_on_failure=False
        )
        client.connect_timeout = CONNECT_TIMEOUT_S
        if not self._modern:
            client.max_inflight_messages_set(UNACKED_LIMIT)  # on 5 the broker's Receive Maximum may be paho's 20
            if self.as_published:
                client.enable_bridge_mode()
        if self._settings.username is not None:
            client.username_pw_set(self._settings.username, self._settings.password)
        if context is not None:
            client.tls_set_context(context)
        if will is not None:
            client.will_set(will.topic, will.payload, int(will.qos), will.retain)
        client.on_pong = self._on_pong
        client.on_too_long = self._on_too_long
        client.skips = self._skips
        client.on_socket_open = self._on_socket_open
        client.on_socket_register_write = self._on_register_write
        client.on_connect = self._on_connect
        client.on_disconnect = self._on_disconnect
        client.on_subscribe = self._on_subscribe
        client.on_unsubscribe = self._on_unsubscribe
        client.on_publish = self._on_publish
        client.on_message = self._on_message
        client.on_publication = self._on_publication
        return client

    def _note_answer(self) -> None:
        self._packets += 1
        self._answered_at = clock.since_boot()

    def _on_socket_open(self, _client: Any, _data: Any, sock: Any) -> None:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)

    def _on_register_write(self, _client: Any, _data: Any, _sock: Any) -> None:
        """If this is set, paho does not write by itself; we write after every call that queues something."""

    def _on_connect(self, _client: Any, _data: Any, _flags: Any, reason: ReasonCode, properties: Any) -> None:
        self.max_packet = getattr(properties, "MaximumPacketSize", None)
        started = self._answered_at
        self._note_answer()
        self._in_flight.measured(self._answered_at - started)
        self._delay.usual(self._answered_at - started)
        self.hesitated = self._answered_at - started > _HESITATION_S
        if reason.is_failure:
            self._refusal = f"{self.where} refused us: {_explain(reason)}"
        else:
            self._accepted = True

    def _on_disconnect(self, _client: Any, _data: Any, flags: Any, reason: ReasonCode, _properties: Any) -> None:
        if flags.is_disconnect_packet_from_server:
            self._disconnect_reason = f"{self.where} closed the connection: {reason.getName().lower()}"

    def _on_subscribe(self, _client: Any, _data: Any, mid: int, reasons: list[ReasonCode], _properties: Any) -> None:
        answers = list(zip(self._asked.get(mid, ()), reasons, strict=False))
        self._answers.update((filter_, reason.is_failure) for filter_, reason in answers)
        refused = [f"{filter_} ({reason})" for filter_, reason in answers if reason.is_failure]
        if refused:
            self._counters.add("subscriptions_refused")
            log.warning("%s refused to subscribe us to %s", self.where, ", ".join(refused))
        self._on_request_answered(mid)

    def _on_unsubscribe(self, _client: Any, _data: Any, mid: int, _reasons: Any, _properties: Any) -> None:
        self._on_request_answered(mid)

    def _on_request_answered(self, mid: int) -> None:
        self._note_answer()
        self._asked.pop(mid, None)
        self._in_flight.answer(mid)

    def _on_publish(self, _client: Any, _data: Any, mid: int, _reason: Any, _properties: Any) -> None:
        """Called by paho also for QoS 0 messages, which are only written."""
        now = clock.since_boot()
        sent_at = self._in_flight.acknowledge(mid, now)
        if sent_at is not None:
            self._note_answer()
            self._delay.acknowledged(sent_at, now)

    def _on_message(self, _client: Any, _data: Any, raw: paho.MQTTMessage) -> None:
        first = (_ANY_QOS if raw.qos else 0) | (_RETAIN if raw.retain else 0)
        self._on_publication(raw._topic, bytes(raw.payload), first)

    def _on_publication(self, raw_topic: bytes, payload: bytes, first: int) -> None:
        self._packets += 1
        try:
            topic = raw_topic.decode()
        except UnicodeDecodeError:
            self._counters.add("malformed")
            return
        retain = bool(first & _RETAIN)
        retain_requested = retain if self.as_published else (True if retain else None)
        qos = QoS.DELIVERED if first & _ANY_QOS else QoS.LATEST
        self._inbox.append(Message(topic, payload, qos, retain, retain_requested, self._since))

    def _skips(self, topic: bytes) -> bool:
        if self._inbox:
            return False  # what came before may change the answer
        try:
            skipped = self._skips_retained(topic)
        except Exception:  # foreign code on our thread
            log.exception("asking whether to skip a retained message of %r failed", topic)
            return False
        if skipped:
            self._packets += 1
            self.arriving_at = clock.since_boot()
        return skipped

    def _on_too_long(self, topic: bytes, length: int) -> None:
        self._packets += 1
        self._counters.add("too_long")
        log.debug("%s sent %d bytes on %r: discarded", self.where, length, topic)


def _explain(reason: ReasonCode) -> str:
    name = reason.getName()
    if name == "Not authorized":  # mosquitto's answer to a wrong password on 3.1.1
        return "not authorized (bad user name or password?)"
    return str(name[:1].lower() + name[1:])
