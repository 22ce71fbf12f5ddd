"""One connection to an MQTT broker, from CONNECT to its loss.

It is discarded as a whole, so that nothing in a queue can outlive a disconnect (T4, T19). One network thread calls
`pump`, any thread calls `publish`. One lock guards the client: two threads would mix the bytes of two packets, and
OpenSSL does not support reading and writing at once. It is not held while a handler runs.
"""

from __future__ import annotations

import logging
import os
import random
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from math import ceil, inf
from typing import TYPE_CHECKING

from pebble.transports import clock, hosts
from pebble.transports.base import Message, Outgoing, QoS
from pebble.transports.counters import Counters
from pebble.transports.mqtt import reasons
from pebble.transports.mqtt.bridge_mode import Result
from pebble.transports.mqtt.broker_limits import EVERYTHING, Limits
from pebble.transports.mqtt.client import Client, Opening
from pebble.transports.mqtt.read_age import BrokerDelay, WaitingTime, readable_bytes
from pebble.transports.mqtt.outgoing import (
    Backlog,
    InFlightTable,
    PendingAck,
    present_round_trip_s,
    shortest_round_trip_s,
    unconfirmed_bytes,
)
from pebble.transports.mqtt.packets import ANY_QOS, RETAIN, Accepted, Filter, MalformedError
from pebble.transports.mqtt.suspects import Written
from pebble.transports.topics import MAX_BYTES

if TYPE_CHECKING:
    from pebble.transports.mqtt.paho_client import PahoClient

log = logging.getLogger(__name__)

_HESITATION_S = 0.5  # a CONNACK that takes longer comes over a very slow connection, or from a suspended broker
UNACKED_LIMIT = 1000  # DELIVERED messages the broker has not acknowledged; beyond it they are refused,
UNACKED_RESERVE = 100  # except so many stops: the messages before them may be those of strangers
_OVERHEAD = 1 + 4 + 2 + 2 + 1 + 5  # bytes of a PUBLISH besides topic and payload, at most: with an expiry
_CLEAR = 8 * 1024  # bytes ahead of a ping that do not delay it much
_LEAST_PING_S = 0.05  # between two pings, however short the allowed silence
_LEAST_SHARE = 0.75  # of the interval between pings: answers to regular ones could not be told apart
_FRESH_S = 0.05  # what is in a socket that was empty so recently counts as having come just now
_OVERSLEPT_S = 0.1  # poll took so much longer than asked for: the process was stopped, or the machine suspended
_LOGGED = 200  # bytes of a topic
_UNWRITTEN = 1 << 20  # bytes of DELIVERED messages that wait where the broker has no QoS 1; beyond it they are refused
_LACKS = {reasons.NO_RETAIN: Result.RETAIN_REFUSED, reasons.NO_QOS: Result.QOS_REFUSED}
_BATCH = 64  # messages read in a row before they are delivered
_QUICKACK = getattr(socket, "TCP_QUICKACK", None)  # Linux only
_ABORT = struct.pack("ii", 1, 0)  # SO_LINGER that makes close() drop what was not sent


class Lost(Exception):  # noqa: N818  (an event, not a mistake)
    """The connection was lost, or could not be made. Its text explains why."""


class Silent(Lost):
    """The other side does not answer."""


class Absent(Lost):
    """Nothing listens there."""


class Refused(Lost):
    """The broker refused our CONNECT, or closed the connection instead of answering."""

    def __init__(self, text: str, result: Result = Result.FAILED) -> None:
        super().__init__(text)
        self.result = result


class _Poll:
    """Waits until ``sock`` is readable or has an error, or (with ``write``) writable, or ``wake`` is readable."""

    def __init__(self, sock: int, wake: int) -> None:
        self._sock, self._wake, self._write = sock, wake, False
        self._poll = select.poll() if hasattr(select, "poll") else None  # Windows has none
        if self._poll is not None:
            self._poll.register(sock, select.POLLIN)
            self._poll.register(wake, select.POLLIN)

    def wait(self, seconds: float, *, write: bool) -> tuple[bool, bool, bool]:
        """Which of the three: readable, writable, woken."""
        if self._poll is None:
            return self._select(seconds, write=write)
        if write is not self._write:
            self._write = write
            self._poll.modify(self._sock, select.POLLIN | (select.POLLOUT if write else 0))
        readable = writable = woken = False
        for descriptor, seen in self._poll.poll(ceil(seconds * 1000)):
            if descriptor == self._wake:
                woken = True
            else:
                readable, writable = bool(seen & ~select.POLLOUT), bool(seen & select.POLLOUT)
        return readable, writable, woken

    def _select(self, seconds: float, *, write: bool) -> tuple[bool, bool, bool]:
        try:
            ready = select.select([self._sock, self._wake], [self._sock] if write else [], [self._sock], seconds)
        except (OSError, ValueError):  # closed meanwhile: reading it says so
            return True, False, False
        return self._sock in ready[0] + ready[2], bool(ready[1]), self._wake in ready[0]


def _client_class() -> type[Client] | type[PahoClient]:
    if os.environ.get("PEBBLE_MQTT_CLIENT") != "paho":
        return Client
    from pebble.transports.mqtt.paho_client import PahoClient

    return PahoClient


def ignore(_messages: list[Message]) -> None:
    """Discard messages: for :meth:`Connection.pump` before a connection is accepted, and at its end."""


class Connection:
    """One connection: a client, the backlog of its socket, and the acknowledgements that the broker owes.

    `as_published` uses bridge mode on 3.1.1, and noLocal and retain-as-published on 5 (T7, T16). `on_answers` is called
    on the network thread with the filters that the broker has answered, and whether it refused each (T21), and
    `on_refusal` with the topic of a message that it does not take, and the reason (MQTT 5).
    """

    def __init__(
        self,
        opening: Opening,
        counters: Counters,
        *,
        where: str,
        as_published: bool,
        limits: Limits = EVERYTHING,
        on_answers: Callable[[Mapping[str, bool]], None],
        skips_retained: Callable[[bytes], bool],
        on_refusal: Callable[[str, str], None],
        is_stop: Callable[[str], bool] = lambda _topic: False,
    ) -> None:
        settings = opening.settings
        self.as_published = as_published
        self.dialling = True  # connect(2) or a TLS handshake may be blocking, and cannot be interrupted
        self.hesitated = False  # the broker took so long to accept us that it may have been suspended
        self.where = where  # the broker, in words
        self.max_packet: int | None = None  # bytes, as the broker says on MQTT 5
        self.limits = limits  # what the broker has, with what it says on MQTT 5
        self.lacks: Result | None = None  # why it has closed the connection, if it lacks something
        #: When there was the last sign that the answers are behind retained messages, or behind a long one.
        self.arriving_at = float("-inf")
        self._settings, self._counters = settings, counters
        self._modern = settings.protocol == "5"
        self._lock = threading.RLock()
        self._inbox: list[Message] = []
        self._on_answers, self._skips_retained = on_answers, skips_retained
        self._on_refusal, self._is_stop = on_refusal, is_stop
        self._asked: dict[int, list[str]] = {}  # the filters of each SUBSCRIBE without an answer, by message id
        self._answers: dict[str, bool] = {}  # filters answered since the last `on_answers`: refused?
        self._backlog = Backlog()
        self._in_flight = InFlightTable()
        self._answered_at = clock.since_boot()
        self._waiting = WaitingTime(self._answered_at)
        self._delay = BrokerDelay()
        self._since = self._answered_at  # of the batch that is read
        keepalive_s = settings.keepalive_s or inf  # 0: none
        self._ping_interval_s = max(_LEAST_PING_S, min(settings.silence_s, keepalive_s) / 4)
        self._ping_due_at = inf  # once accepted they are sent regularly: other answers come only to what we publish
        self._packets = 0  # received so far
        self._received_at = self._answered_at  # before the socket was emptied, or a piece of what is in it taken out
        self._stalled_since = self._answered_at  # when the last time without reading began, for which a ping was sent
        #: Topics whose next message is followed by a ping at once: its answer shows that the broker accepts it.
        self.doubtful: set[str] = set()
        self._more = False  # a batch ended before the socket was empty
        self._copies = False  # there are retained messages in the batch
        self._accepted = False
        self._refusal: Refused | None = None
        self._disconnect_reason = ""
        self._hung_up = False  # the broker has sent DISCONNECT, for a reason that may be a message
        self._taken_over = True  # may be: MQTT 3.1.1 has no words for it
        self._wake_read, self._wake_write = socket.socketpair()
        self._wake_read.setblocking(False)
        self._wake_write.setblocking(False)
        self._poll: _Poll | None = None
        bridge = as_published and not self._modern
        self._client = _client_class()(opening, self, bridge=bridge)

    # -- opening and closing

    def connect(self, stopping: threading.Event) -> None:
        """Connect and wait for the broker's CONNACK, or for ``stopping``; raises Lost."""
        try:
            self._client.open()
        except (OSError, ValueError) as error:
            kind = Absent if isinstance(error, ConnectionRefusedError) else Lost
            raise kind(f"{self.where} cannot be reached: {error}") from None
        self.dialling = False
        self._answered_at = clock.since_boot()
        deadline = time.monotonic() + hosts.CONNECT_TIMEOUT_S
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
            if self._client.socket is None:
                raise Refused(f"{self.where} hung up on our CONNECT", Result.HUNG_UP) from None
            raise lost from None

    def discard(self) -> None:
        """Reset the connection without DISCONNECT; all queued data is lost, in the kernel too."""
        with self._lock:
            sock = self._client.socket
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
        readable, now = self._wait(timeout)
        client = self._client
        with self._lock:
            # Before reading: messages queued during a silence must not arrive as if they were fresh (T19).
            if now - self._answered_at > self._settings.silence_s:
                self._check_silence(now)
            if readable or self._more:
                self._read(now)
            if client.waiting or self._backlog.waiting:
                self._write()
            if now >= self._ping_due_at:
                self._ping()
            owes = client.owes
            if not owes:
                self._quick_ack()
            messages, self._inbox = self._inbox, []
            answers, self._answers = self._answers, {}
        if answers:
            self._on_answers(answers)
        try:
            if messages:
                receive(messages)
        finally:
            if owes:
                with self._lock:
                    client.acknowledge()
        if self._copies:
            self._note_copies()  # again: they may take longer to handle than an answer may
            self._copies = False
        if self._in_flight.answered:
            self._in_flight.complete()

    def _wait(self, timeout: float) -> tuple[bool, float]:
        """Whether there is something to read, and when that was known: what follows goes by that one time."""
        poll = self._poll or self._make_poll()
        if self._client.socket is None:
            raise Lost(self._closed)
        blocked = bool(self._client.waiting)
        began = now = clock.since_boot()
        wait = min(timeout, self._ping_due_at - began)
        readable = writable = woken = False
        is_fresh = not self._more and began - self._waiting.checked_at <= _FRESH_S
        if not is_fresh:
            readable, writable, woken = poll.wait(0.0, write=blocked)
            now = clock.since_boot()
        if not (readable or writable or woken or self._more):
            if not is_fresh:
                self._waiting.empty(began)
            readable, writable, woken = poll.wait(max(wait, 0.0), write=blocked)
            if (now := clock.since_boot()) - began <= wait + _OVERSLEPT_S:
                self._waiting.empty(now)  # until just now
        if woken:
            self._wake_read.recv(4096)
        if writable:
            self._answered_at = now  # the other side's TCP accepted some: slow, but alive
        return readable, now

    def _make_poll(self) -> _Poll:
        with self._lock:
            if self._client.socket is None:
                raise Lost(self._closed)
            self._poll = _Poll(self._client.socket.fileno(), self._wake_read.fileno())
        return self._poll

    def _check_silence(self, now: float) -> None:
        if not self._accepted:
            return  # `connect` has its own deadline, and gives the first round trip
        silence_s = now - max(self._answered_at, self.arriving_at)
        if silence_s > self._settings.silence_s and silence_s > (limit := self._silence_limit_s):
            self._counters.add("silences")
            raise Silent(f"{self.where} has not answered for {limit:.1f} s")

    @property
    def _silence_limit_s(self) -> float:
        return max(self._settings.silence_s, 4 * _LEAST_PING_S, 4 * self._in_flight.round_trip_s)

    def _waiting_since(self, now: float) -> float:
        """Since when what is read now may have waited, here or at the broker."""
        sock = self._client.socket
        waited = self._delay.seconds(now, lambda: 0.0 if sock is None else present_round_trip_s(sock))
        return min(self._waiting.since, now - waited) if waited > 0 else self._waiting.since

    def _note_copies(self) -> None:
        self.arriving_at = clock.since_boot()

    def _read(self, now: float) -> None:
        """Read up to a batch: several times, where more than fits at once has come, or a piece of what TLS unpacks.

        ``now``: a time before anything is read.
        """
        client, first, size = self._client, self._packets, 0
        unread = client.unread if self._more else 0
        self._more = True
        while self._more and self._packets - first < _BATCH:
            before = self._packets
            if not unread:
                self._received_at = now
                if now - self._waiting.checked_at > _OVERSLEPT_S and self._accepted:
                    self._ping_after_stall(now)
                unread = client.receive()
                self._waiting.found(unread if client.drained else unread + self._readable, now)
            self._since = self._waiting_since(now)
            try:
                left = client.read(_BATCH - (before - first))
            except MalformedError as error:
                raise Lost(f"{self.where} does not speak MQTT: {error}") from None
            if self._refusal is not None:
                raise self._refusal
            size += unread - left
            self._more = left > 0 or not client.drained
            if not self._more:
                break
            self._waiting.read(unread - left)
            if self._packets == before:
                break
            unread, now = left, clock.since_boot()
        if size and self._packets == first:
            self.arriving_at = clock.since_boot()  # a piece of a long message
        if self._copies:
            self._note_copies()
        if not self._more:
            self._waiting.empty(self._received_at)

    @property
    def _readable(self) -> int:
        sock = self._client.socket
        return 0 if sock is None else readable_bytes(sock)

    @property
    def _closed(self) -> str:
        why, id_ = self._disconnect_reason or f"{self.where} closed the connection", self._settings.client_id
        if id_ is not None and self._accepted and self._taken_over:
            why += f' (does another client use the client id "{id_}"? a broker lets in only the newest)'
        return why

    def _write(self) -> None:
        self._client.write()
        while self._backlog.waiting and self._client.socket is not None and not self._client.waiting:
            self._write_publish(self._backlog.take(), None)

    def _quick_ack(self) -> None:
        """Send TCP's ACKs at once: a broker with Nagle's algorithm delays its next message until then (up to 40 ms).

        The kernel falls back to delayed ACKs whenever we send, so this is called after every read, unless MQTT's own
        acknowledgements follow and carry TCP's.
        """
        sock = self._client.socket
        if _QUICKACK is not None and sock is not None:
            try:  # noqa: SIM105  (hot)
                sock.setsockopt(socket.IPPROTO_TCP, _QUICKACK, 1)
            except OSError:  # the other side has just gone
                pass

    # -- ping

    def ping(self) -> PendingAck:
        """Send a ping: its answer proves that the broker has processed everything sent before."""
        ack = PendingAck()
        with self._lock:
            self._ping(ack)
        return ack

    def _ping(self, ack: PendingAck | None = None) -> None:
        sock = self._client.socket
        ahead = self._client.unwritten + (0 if sock is None else unconfirmed_bytes(sock))
        now = clock.since_boot()
        self._ping_due_at = now + self._ping_interval_s * random.uniform(_LEAST_SHARE, 1.0)  # noqa: S311  (no secret)
        self._in_flight.ping(now, ack)
        self._delay.asked(now, clear=ahead <= _CLEAR)
        self._client.ping()

    def _ping_after_stall(self, now: float) -> None:
        """Once for each time without reading: its answer comes after what has waited at the broker meanwhile."""
        since = self._waiting.checked_at
        if since != self._stalled_since:
            self._stalled_since = since
            self._in_flight.ping(now, None)
            self._delay.stalled(since, now)
            self._client.ping()

    def on_pong(self) -> None:
        self._note_answer()
        self._in_flight.pong(self._answered_at)
        self._delay.answered(self._answered_at)

    # -- any thread

    def publish(self, message: Message, *, expires_s: int | None = None) -> bool:
        """Send a message; False if that is impossible. A LATEST one may wait, and be dropped for a newer one."""
        with self._lock:
            if self._client.socket is None:
                return False
            if message.qos is QoS.DELIVERED and self._in_flight.unacked >= UNACKED_LIMIT and self._is_full(message):
                return False
            if not self.limits.qos and self._client.unwritten > _UNWRITTEN and not self._is_stop(message.topic):
                return False
            if message.retain and self.limits.retain:
                self._in_flight.accept(message)
            if message.qos is QoS.LATEST and self._client.waiting:
                self._counters.add("dropped", self._backlog.put(message))
            else:
                if self._backlog.waiting:
                    self._counters.add("dropped", self._backlog.supersede(message))
                self._write_publish(message, expires_s)
            blocked = self._client.socket is None or self._client.waiting
        if blocked:
            self.wake()
        return True

    def takes(self, message: Message) -> bool:
        """Whether the broker has not said that ``message`` is too large."""
        if self.max_packet is None:
            return True
        return _OVERHEAD + len(message.topic.encode()) + len(message.payload) <= self.max_packet

    def _is_full(self, message: Message) -> bool:
        beyond = self._in_flight.unacked - UNACKED_LIMIT
        return beyond >= UNACKED_RESERVE or not self._is_stop(message.topic)

    def _write_publish(self, message: Message, expires_s: int | None) -> None:
        if self.limits is not EVERYTHING:
            message = self.limits.fit(message)
        mid = self._client.publish(
            message.topic, message.payload, int(message.qos), retain=message.retain, expires_s=expires_s
        )
        self._in_flight.sent(message, mid, clock.since_boot())
        if self.doubtful and message.topic in self.doubtful:
            self.doubtful.discard(message.topic)
            self._ping()

    def subscribe(self, filters: Iterable[tuple[str, bool]], qos: QoS = QoS.DELIVERED) -> PendingAck:
        """Subscribe to filters, each with its noLocal option (MQTT 5 only)."""
        most, sends_retained = min(int(qos), self._settings.max_qos), self._settings.sends_retained
        wanted = [Filter(text, most, no_local, self.as_published, sends_retained) for text, no_local in filters]
        return self._request(lambda: self._client.subscribe(wanted), wanted, [one.text for one in wanted])

    def unsubscribe(self, filters: list[str]) -> PendingAck:
        return self._request(lambda: self._client.unsubscribe(filters), filters, [])

    def _request(self, send: Callable[[], int], filters: Sequence[object], asked: list[str]) -> PendingAck:
        ack = PendingAck()
        if not filters:
            ack.complete()
            return ack
        with self._lock:
            if self._client.socket is None:
                ack.complete()
            else:
                mid = send()
                self._in_flight.ask(mid, ack)
                self._asked[mid] = asked
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
            return not (self._in_flight.unacked or self._backlog.waiting or self._client.waiting)

    @property
    def unacked(self) -> int:
        return self._in_flight.unacked

    @property
    def outgoing(self) -> Outgoing:
        with self._lock:
            sock = self._client.socket
            if sock is None:
                return Outgoing()
            waiting = self._backlog.size + self._client.unwritten + unconfirmed_bytes(sock)
            round_trip_s, since = shortest_round_trip_s(sock), self._in_flight.waiting_since
            # TCP may end before the broker; and brokers without TCP_NODELAY send an answer after that to the one before
            usual_s = 2 * max(round_trip_s, self._in_flight.round_trip_s)
            stalled_s = 0.0 if since is None else max(0.0, clock.since_boot() - since - usual_s)
            return Outgoing(waiting, round_trip_s, stalled_s)

    @property
    def confirmed(self) -> Limits:
        """What this connection has shown the broker to have."""
        return Limits(self._in_flight.has_retained, int(self._in_flight.has_acknowledged))

    def unconfirmed_retained(self) -> list[Message]:
        """Retained messages that the broker may not have received, oldest first."""
        with self._lock:
            return self._in_flight.unconfirmed_retained()

    def has_accepted(self, topic: str, size: int) -> bool:
        """Whether the broker has answered a ping after a message of ``topic`` that was as large."""
        with self._lock:
            return self._in_flight.has_accepted(topic, size)

    def written_before_loss(self) -> dict[str, Written] | None:
        """What the other side may have closed the connection for; None: it has not, or for another reason."""
        with self._lock:
            if not (self._hung_up or (self._client.hung_up and not self._disconnect_reason)):
                return None
            return self._in_flight.first_written(clock.since_boot())

    # -- called by the client: on the network thread, with the lock held

    def _note_answer(self) -> None:
        self._packets += 1
        self._answered_at = clock.since_boot()

    def on_accepted(self, accepted: Accepted) -> None:
        self.max_packet = accepted.max_packet
        stated = Limits(accepted.retain != 0, 1 if accepted.max_qos is None else min(accepted.max_qos, 1))
        if stated != EVERYTHING:
            self.limits = self.limits.both(stated)
        self._note_connack()
        self._ping_due_at = self._answered_at + self._ping_interval_s
        self._accepted = True

    def on_refused(self, code: int) -> None:
        self._note_connack()
        refused = f"{self.where} refused us: "
        if code == reasons.PROTOCOL_REFUSED and not self._modern:
            self._refusal = Refused(refused + Result.PROTOCOL_REFUSED.value, Result.PROTOCOL_REFUSED)
        else:
            self._refusal = Refused(refused + reasons.connection_refused(code), _LACKS.get(code, Result.FAILED))

    def _note_connack(self) -> None:
        started = self._answered_at
        self._note_answer()
        self._in_flight.measured(self._answered_at - started)
        self._delay.usual(self._answered_at - started)
        self.hesitated = self._answered_at - started > _HESITATION_S

    def on_disconnect(self, code: int) -> None:
        self._disconnect_reason = f"{self.where} closed the connection: {reasons.words(code)}"
        self._taken_over = code == reasons.TAKEN_OVER
        self._hung_up = reasons.may_concern_message(code)
        self.lacks = _LACKS.get(code)
        self._client.close()

    def on_answer(self, mid: int, codes: bytes) -> None:
        self._note_answer()
        answers = list(zip(self._asked.pop(mid, ()), codes, strict=False))
        self._answers.update((filter_, code >= reasons.FAILURE) for filter_, code in answers)
        refused = [f"{filter_} ({reasons.words(code)})" for filter_, code in answers if code >= reasons.FAILURE]
        if refused:
            self._counters.add("subscriptions_refused")
            log.warning("%s refused to subscribe us to %s", self.where, ", ".join(refused))
        self._in_flight.answer(mid)

    def on_puback(self, mid: int, code: int) -> None:
        now = clock.since_boot()
        if code >= reasons.FAILURE and (topic := self._in_flight.topic_of(mid)) is not None:
            self._counters.add("publications_refused")
            self._on_refusal(topic, reasons.words(code))
        sent_at = self._in_flight.acknowledge(mid, now)
        if sent_at is not None:
            self._packets += 1
            self._answered_at = now
            self._delay.acknowledged(sent_at, now)

    def on_publication(self, topic: bytes, payload: bytes, first: int) -> None:
        retain = bool(first & RETAIN)
        self._copies |= retain
        if len(topic) > MAX_BYTES:  # no transport carries it, and much would be remembered of many
            self.on_too_long(topic, len(topic) + len(payload))
            return
        self._packets += 1
        try:
            text = topic.decode()
        except UnicodeDecodeError:
            self._counters.add("malformed")
            return
        retain_requested = retain if self.as_published else (True if retain else None)
        qos = QoS.DELIVERED if first & ANY_QOS else QoS.LATEST
        self._inbox.append(Message(text, payload, qos, retain, retain_requested, self._since))

    def skips(self, topic: bytes) -> bool:
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

    def on_too_long(self, topic: bytes, length: int) -> None:
        self._packets += 1
        self._counters.add("too_long")
        log.debug("%s sent %d bytes on %r…: discarded", self.where, length, topic[:_LOGGED])
