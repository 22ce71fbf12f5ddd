"""One connection to an MQTT broker, from CONNECT to its loss.

It is discarded as a whole, so that no queued message can outlive a disconnect (T4, T19). One network thread calls
`pump`, any thread calls `publish`. One lock guards the client: two threads would mix the bytes of two packets, and
OpenSSL does not support reading and writing at once. The lock is not held while a handler runs.
"""

import socket
import struct
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import TypeVar

from pebble.transports import clock, hosts
from pebble.transports.base import Answer, Message, Outgoing, QoS
from pebble.transports.counters import Counters
from pebble.transports.mqtt.bridge_mode import Result
from pebble.transports.mqtt.broker_limits import EVERYTHING, Limits
from pebble.transports.mqtt.client import Client, Opening, TlsLateError, keep_unsent
from pebble.transports.mqtt.ending import WANTS_TLS, Absent, Lost, Refused, Silent, TlsLate, alert, unreached
from pebble.transports.mqtt.incoming import OVERSLEPT_S, Incoming, Owner
from pebble.transports.mqtt.outgoing import (
    Backlog,
    InFlightTable,
    PendingAck,
    present_round_trip_s,
    shortest_round_trip_s,
    unconfirmed_bytes,
)
from pebble.transports.mqtt.packets import Filter
from pebble.transports.mqtt.poll import NOTHING, SocketPoll

T = TypeVar("T")
FILTERS = 8  # in one packet: AWS IoT closes the connection for more
UNACKED_LIMIT = 1000  # messages of QoS 1 that the broker has not acknowledged; beyond it they are refused,
UNACKED_RESERVE = 100  # except so many stops: the messages before them may be those of strangers
_OVERHEAD = 1 + 4 + 2 + 2 + 1 + 5  # bytes of a PUBLISH besides topic and payload, at most: with an expiry
_FRESH_S = 0.05  # what is in a socket that was empty so recently counts as having come just now
_UNWRITTEN = 1 << 20  # bytes that wait to be sent where the broker has no QoS 1; beyond it messages are refused
_UNSENT = 4 * 1024  # bytes in the kernel beyond those on their way, over a thin link
_UNREACHED: dict[type[Exception], type[Lost]] = {ConnectionRefusedError: Absent, TlsLateError: TlsLate}
_BY_SYSTEM = 0  # as the system has it
_QUICKACK = getattr(socket, "TCP_QUICKACK", None)  # Linux only
_ONCE = 2  # of TCP_QUICKACK: what is due now; the next one again waits a moment for MQTT's own, to go along with it
_ABORT = struct.pack("ii", 1, 0)  # SO_LINGER that makes close() drop what was not sent


def ignore(_messages: list[Message]) -> None:
    """Discard messages. :meth:`Connection.pump` gets this before a connection is accepted, and at its end."""


class Connection:
    """A connection: a client, the backlog of its socket, and the acknowledgements that the broker owes.

    `as_published` uses bridge mode on 3.1.1, and noLocal and retain-as-published on 5 (T7, T16).
    """

    def __init__(
        self,
        opening: Opening,
        counters: Counters,
        owner: Owner,
        *,
        where: str,
        as_published: bool,
        limits: Limits = EVERYTHING,
        client_class: type[Client] = Client,
    ) -> None:
        self.opened_s = 0.0  # seconds that TCP and TLS took
        self.dialling = True  # connect(2) or a TLS handshake may be blocking, and cannot be interrupted
        self.limits = limits  # of the broker, also those that it states on MQTT 5
        self.max_packet: int | None = None  # bytes, as the broker states on MQTT 5
        self._owner, self._settings, self._counters = owner, opening.settings, counters
        self._lock = threading.RLock()
        self._backlog = Backlog()
        self.in_flight = InFlightTable()
        self.incoming = Incoming(
            opening.settings, owner, counters, self.in_flight, where=where, as_published=as_published
        )
        self.pings = self.incoming.pings
        self._poll = SocketPoll()
        bridge = as_published and opening.settings.protocol != "5"
        self.client = client_class(opening, self.incoming, bridge=bridge)

    # -- opening and closing

    def connect(self, stopping: threading.Event) -> float:
        """Connect and wait for the broker's CONNACK, or for ``stopping``; return the seconds until it came.

        Raises Lost.
        """
        dialled = time.monotonic()
        try:
            self.client.open()
        except (OSError, ValueError) as error:
            # By the kind of the error: Absent if nothing listens there, TlsLate if TLS takes too long, else Lost.
            ending = next((ending for kind, ending in _UNREACHED.items() if isinstance(error, kind)), Lost)
            why = unreached(error, tls=self._settings.tls is not None)
            raise ending(f"{self.where} cannot be reached: {why}") from None
        self.opened_s = time.monotonic() - dialled
        self.incoming.answered_at = began = clock.since_boot()  # the CONNACK sets it anew
        self.dialling = False
        deadline = time.monotonic() + hosts.CONNECT_TIMEOUT_S
        try:
            while (accepted := self.incoming.accepted) is None:
                if stopping.is_set():
                    raise Lost("closed")
                if time.monotonic() > deadline:
                    raise Silent(f"{self.where} accepts connections but does not speak MQTT in time")
                self.pump(deadline - time.monotonic(), ignore)
        except Refused:
            raise
        except Lost as lost:
            failure = self.client.failure
            if failure is not None and alert(failure):  # TLS 1.3: that our certificate is refused shows only now
                raise Lost(f"{self.where} cannot be reached: {unreached(failure, tls=True)}") from None
            if self.client.socket is None:  # the broker closed it
                fix = "" if self._settings.tls else f"; {WANTS_TLS}"
                raise Refused(f"{self.where} hung up on our CONNECT{fix}", Result.HUNG_UP) from None
            raise lost from None
        self.max_packet = accepted.max_packet
        stated = Limits(accepted.retain != 0, 1 if accepted.max_qos is None else min(accepted.max_qos, 1))
        if stated != EVERYTHING:
            self.limits = self.limits.both(stated)
        return self.incoming.answered_at - began

    def discard(self) -> None:
        """Reset the connection without DISCONNECT; all queued data is lost, in the kernel too."""
        with self._lock:
            sock = self.client.socket
            if sock is not None:
                with suppress(OSError):  # it may be closed already
                    sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _ABORT)
                sock.close()
            self._poll.close()
            self.in_flight.end()

    def disconnect(self) -> None:
        """Send DISCONNECT, which makes the broker discard our will."""
        with self._lock:
            self.client.disconnect()

    def wake(self) -> None:
        """Make `pump` return; other threads call it."""
        self._poll.wake()

    def suit(self, *, thin: bool) -> None:
        """Adapt to a thin link to the broker, or to a wide one; see `Transport.is_thin`."""
        with self._lock:
            sock = self.client.socket
            if sock is not None and thin is not self.pings.is_thin:
                keep_unsent(sock, _UNSENT if thin else _BY_SYSTEM)
            self.pings.is_thin = thin

    # -- the network thread

    def pump(self, timeout: float, receive: Callable[[list[Message]], None]) -> None:
        """Wait up to ``timeout`` seconds for the socket, read and write, and deliver messages. Raises Lost.

        Answers to subscriptions are noted first. Then ``receive`` gets the messages. Last, each answered `PendingAck`
        is completed: no retained message is delivered after the confirmation of its subscription.
        """
        readable, now = self._wait(timeout)
        client, incoming = self.client, self.incoming
        with self._lock:
            # Before reading: messages queued during a silence must not arrive as if they were fresh (T19).
            if now - incoming.answered_at > incoming.silence_s:
                incoming.check_silence(now)
            if readable or incoming.more:
                incoming.read(client, now)
            if client.waiting or self._backlog.waiting:
                self._write()
            if now >= self.pings.due_at:
                self.pings.send(client)
            owes = client.owes
            if not owes:  # otherwise MQTT's acknowledgements carry TCP's
                self._quick_ack()
            messages, incoming.messages = incoming.messages, []
            answers = incoming.answers
            if answers:
                incoming.answers = {}
        if answers:
            self._owner.note_answers(answers)
        try:
            if messages:
                receive(messages)
        finally:
            if owes:
                with self._lock:
                    client.acknowledge()
        incoming.age.delay.delivered()  # also without messages: what came before a ping's answer is handled now
        if incoming.age.has_retained:  # their handlers may have taken long: the broker was not silent meanwhile
            incoming.age.note_handled()
        if self.in_flight.answered:
            self.in_flight.complete()

    def _wait(self, timeout: float) -> tuple[bool, float]:
        """Return whether the socket is readable, and the time when this was known.

        Bytes that are already in the socket have come at an unknown time. So it is polled without a wait first, unless
        it was found empty a moment ago: what comes after that has just come. ``waiting`` notes when it was empty.
        """
        if not self._poll.registered:
            with self._lock:
                if self.client.socket is not None:
                    self._poll.register(self.client.socket)
        if self.client.socket is None:
            raise self.incoming.lost
        blocked, waiting = bool(self.client.waiting), self.incoming.age.waiting  # client.waiting: to be written
        began = now = clock.since_boot()
        wait_s = min(timeout, self.pings.due_at - began)
        ready = NOTHING
        was_just_empty = not self.incoming.more and began - waiting.checked_at <= _FRESH_S
        if not was_just_empty:
            ready = self._poll.wait(0.0, write=blocked)
            now = clock.since_boot()
        if ready == NOTHING and not self.incoming.more:
            if not was_just_empty:
                waiting.empty(began)  # as the poll has found nothing since then
            ready = self._poll.wait(max(wait_s, 0.0), write=blocked)
            now = clock.since_boot()
            if now - began <= wait_s + OVERSLEPT_S:
                waiting.empty(now)  # it was empty until now: the process did not sleep, so any bytes have just come
        readable, writable, _woken = ready
        if writable:
            self.incoming.answered_at = now  # the other side's TCP accepted some bytes: slow, but alive
        return readable, now

    def _write(self) -> None:
        self.client.write()
        while self._backlog.waiting and self.client.socket is not None and not self.client.waiting:
            self._write_publish(self._backlog.take(), None)

    def _quick_ack(self) -> None:
        """Send TCP's ACKs at once: a broker with Nagle's algorithm delays its next message until then (up to 40 ms).

        The kernel falls back to delayed ACKs whenever we send, so this is called after every read, unless MQTT's own
        acknowledgements follow and carry TCP's. On a thin link TCP's next ACK waits for MQTT's, see `_ONCE`.
        """
        sock = self.client.socket
        if _QUICKACK is not None and sock is not None:
            try:  # noqa: SIM105  (hot)
                sock.setsockopt(socket.IPPROTO_TCP, _QUICKACK, _ONCE if self.pings.is_thin else 1)
            except OSError:  # the other side has just gone
                pass

    # -- any thread

    def ping(self) -> PendingAck:
        """Send a ping, whose answer proves that the broker has processed everything sent before."""
        ack = PendingAck()
        with self._lock:
            self.pings.send(self.client, ack)
        return ack

    def publish(self, message: Message, *, expires_s: int | None = None) -> bool:
        """Send a message; False if that is impossible. A message of QoS 0 may wait, and be dropped for a newer one."""
        with self._lock:
            client, limits = self.client, self.limits
            if client.socket is None:
                return False
            if message.qos is QoS.DELIVERED and self.in_flight.unacked >= UNACKED_LIMIT and self._is_too_many(message):
                return False
            # Without QoS 1 nothing is acknowledged: then the bytes that wait are limited.
            if not limits.qos and client.unwritten > _UNWRITTEN and not self._owner.policy.is_stop(message.topic):
                return False
            if message.retain and limits.retain:
                self.in_flight.accept(message)  # so that it is known while the broker has not confirmed it
            if message.qos is QoS.LATEST and client.waiting:
                self._counters.add("dropped", self._backlog.put(message))
            else:
                if self._backlog.waiting:
                    self._counters.add("dropped", self._backlog.supersede(message))
                self._write_publish(message, expires_s)
            blocked = client.socket is None or client.waiting
        if blocked:
            self.wake()
        return True

    def takes(self, message: Message) -> bool:
        """True unless the broker has said that ``message`` is too large."""
        if self.max_packet is None:
            return True
        return _OVERHEAD + len(message.topic.encode()) + len(message.payload) <= self.max_packet

    def _is_too_many(self, message: Message) -> bool:
        """True if ``message`` is refused at UNACKED_LIMIT, as all are but the next UNACKED_RESERVE emergency stops."""
        beyond = self.in_flight.unacked - UNACKED_LIMIT
        return beyond >= UNACKED_RESERVE or not self._owner.policy.is_stop(message.topic)

    def _write_publish(self, message: Message, expires_s: int | None) -> None:
        if self.limits is not EVERYTHING:
            message = self.limits.fit(message)
        mid = self.client.publish(
            message.topic, message.payload, int(message.qos), retain=message.retain, expires_s=expires_s
        )
        self.in_flight.sent(message, mid, clock.since_boot())

    def subscribe(self, filters: Iterable[tuple[str, bool]], qos: QoS = QoS.DELIVERED) -> PendingAck:
        """Subscribe to filters, each with its noLocal option (MQTT 5 only)."""
        most, sends_retained = min(int(qos), self._settings.max_qos), self._settings.sends_retained
        wanted = [
            Filter(text, most, no_local, self.incoming.as_published, sends_retained) for text, no_local in filters
        ]
        return self._request(self.client.subscribe, wanted, [filter_.text for filter_ in wanted])

    def unsubscribe(self, filters: list[str]) -> PendingAck:
        return self._request(self.client.unsubscribe, filters, [])

    def _request(self, send: Callable[[Sequence[T]], int], filters: Sequence[T], asked: Sequence[str]) -> PendingAck:
        """Send a few filters in each packet; return the pending answer to the last packet.

        ``asked``: the texts of filters to subscribe to, each of which the broker may refuse; empty to unsubscribe.
        """
        ack = PendingAck()  # of no packet: if none can be sent, it is completed at once
        with self._lock:
            for at in range(0, len(filters), FILTERS):
                if self.client.socket is not None:
                    ack = PendingAck()  # of this packet
                    self.in_flight.ask(send(filters[at : at + FILTERS]), ack, asked[at : at + FILTERS])
            if not filters or self.client.socket is None:
                ack.set()
        self.wake()
        return ack

    # -- state

    @property
    def where(self) -> str:
        """The address of the broker in words, for logs."""
        return self.incoming.where

    @property
    def has_room(self) -> bool:
        return self.in_flight.unacked < UNACKED_LIMIT // 2

    @property
    def drained(self) -> bool:
        """True if all accepted messages are written, and acknowledged if they have QoS 1."""
        with self._lock:
            return not (self.in_flight.unacked or self._backlog.waiting or self.client.waiting)

    @property
    def outgoing(self) -> Outgoing:
        with self._lock:
            sock = self.client.socket
            if sock is None:
                return Outgoing()
            waiting = self._backlog.size + self.client.unwritten + unconfirmed_bytes(sock)
            round_trip_s, since = shortest_round_trip_s(sock), self.in_flight.waiting_since
            # The longer of two round trips, as TCP's may end at a proxy. It counts twice, as a broker without
            # TCP_NODELAY holds an answer back until the one before it is acknowledged.
            usual_s = 2 * max(round_trip_s, self.in_flight.round_trip_s)
            stalled_s = 0.0 if since is None else max(0.0, clock.since_boot() - since - usual_s)
            return Outgoing(waiting, round_trip_s, stalled_s)

    @property
    def answer(self) -> Answer | None:
        """The newest answer to a ping; None before the first one, and without a socket."""
        with self._lock:
            sock = self.client.socket
            if sock is None:
                return None
            number, seconds = self.in_flight.newest_answer(clock.since_boot())
            shortest, present = shortest_round_trip_s(sock), present_round_trip_s(sock)
            queue_s = max(0.0, present - shortest) if shortest else None
            delivered_s, late_s = self.incoming.age.delay.delivery(clock.since_boot())
            return Answer(number, seconds, queue_s, delivered_s, late_s) if number else None

    def unconfirmed_retained(self) -> list[Message]:
        """Return the retained messages that the broker may not have received, oldest first."""
        with self._lock:
            return self.in_flight.unconfirmed_retained()

    def written_before_loss(self) -> dict[str, int] | None:
        """Return by topic the size of a message that may be why the broker hung up; None if no message can be."""
        with self._lock:
            incoming = self.incoming
            if not (incoming.may_concern_message or (self.client.hung_up and not incoming.reason)):
                return None
            return self.in_flight.first_written(clock.since_boot())
