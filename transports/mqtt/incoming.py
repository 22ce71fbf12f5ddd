"""Reads packets from a broker on one MQTT connection, in batches, and makes a message of each PUBLISH, with its age.

Answers to pings show that the broker lives, how far it has read, and how late it is.
"""

import logging
import random
from collections.abc import Mapping
from math import inf
from typing import Protocol

from pebble.transports import clock
from pebble.transports.base import Message, QoS, TopicPolicy
from pebble.transports.counters import Counters
from pebble.transports.mqtt import reasons
from pebble.transports.mqtt.bridge_mode import Result
from pebble.transports.mqtt.client import Client
from pebble.transports.mqtt.ending import Lost, Refused, Silent
from pebble.transports.mqtt.outgoing import InFlightTable, PendingAck, readable_bytes, unconfirmed_bytes
from pebble.transports.mqtt.packets import ANY_QOS, RETAIN, Accepted, MalformedError
from pebble.transports.mqtt.read_age import ReadAge
from pebble.transports.settings import MqttSettings
from pebble.transports.topics import MAX_BYTES

log = logging.getLogger(__name__)

OVERSLEPT_S = 0.1  # a poll that takes so much longer than asked for: the process was stopped, or the machine suspended
_LOGGED = 200  # bytes of a topic
_BATCH = 64  # messages read in a row before they are delivered
_SHOWN = 3  # filters
_CLEAR = 8 * 1024  # bytes ahead of a ping that do not delay it much
_LEAST_S = 0.05  # between two pings, however short the allowed silence
_THIN_S, _THIN_TRIPS, _THIN_INTERVAL_S = 5.0, 8, 1.5  # over a thin link: the limit, and between two pings
_LEAST_SHARE = 0.75  # of the interval between pings: answers to regular ones could not be told apart
_LACKS = {reasons.NO_RETAIN: Result.RETAIN_REFUSED, reasons.NO_QOS: Result.QOS_REFUSED}


class Owner(Protocol):
    """The transport that owns a connection, called on the network thread."""

    policy: TopicPolicy  # asked with the connection's lock held

    def note_refusal(self, topic: str, why: str) -> None:
        """Note that the broker does not accept messages of this topic (MQTT 5). Must neither wait nor publish."""

    def note_answers(self, refused: Mapping[str, bool]) -> None:
        """Note for each filter whether the broker refuses it (T21)."""


class Pings:
    """The schedule of pings. Call it with the connection's lock held."""

    def __init__(self, settings: MqttSettings, in_flight: InFlightTable, age: ReadAge) -> None:
        self._in_flight, self._age = in_flight, age
        self._silence_s = max(settings.silence_s, 4 * _LEAST_S)  # time for four pings
        keepalive_s = settings.keepalive_s or inf  # 0: the broker sets no limit
        self._interval_s = max(_LEAST_S, min(settings.silence_s, keepalive_s) / 4)
        self._thin_interval_s = min(_THIN_INTERVAL_S, keepalive_s / 2)
        self.is_thin = False  # see `Transport.is_thin`
        self.due_at = inf  # until `begin`; then regularly, as without pings only what we publish is answered
        #: When the stall began for which :meth:`send_after_stall` sent its last ping: it sends one for each stall.
        self._stalled_since = age.waiting.checked_at

    def begin(self, now: float) -> None:
        """Note that the broker has accepted us."""
        self.due_at = now + self._interval_s

    def send(self, client: Client, ack: PendingAck | None = None) -> None:
        """Send a ping, and set when the next one is due. If much data is ahead of it, its answer tells no delay."""
        sock = client.socket
        bytes_ahead = client.unwritten + (0 if sock is None else unconfirmed_bytes(sock))
        now = clock.since_boot()
        interval_s = self._thin_interval_s if self.is_thin else self._interval_s
        self.due_at = now + interval_s * random.uniform(_LEAST_SHARE, 1.0)  # noqa: S311  (no secret)
        self._in_flight.ping(now, ack)
        self._age.delay.asked(now, clear=bytes_ahead <= _CLEAR)
        client.ping()

    def send_after_stall(self, client: Client, now: float) -> None:
        """Send one ping after a time without reading: its answer comes after everything that waited at the broker."""
        since = self._age.waiting.checked_at  # nothing was read since then
        if since != self._stalled_since:
            self._stalled_since = since
            self._in_flight.ping(now, None)  # None: no caller waits for its answer
            self._age.delay.stalled(since, now)
            client.ping()

    @property
    def silence_limit_s(self) -> float:
        """Seconds without an answer after which the broker counts as silent."""
        if self.is_thin:
            return max(self._silence_s, _THIN_S, _THIN_TRIPS * self._in_flight.round_trip_s)
        return max(self._silence_s, 4 * self._in_flight.round_trip_s)


class Incoming:
    """The listener of a connection's client; under the connection's lock. ``where``: the broker's address in words."""

    def __init__(
        self,
        settings: MqttSettings,
        owner: Owner,
        counters: Counters,
        in_flight: InFlightTable,
        *,
        where: str,
        as_published: bool,
    ) -> None:
        self.answered_at = clock.since_boot()
        self.silence_s = settings.silence_s
        self.as_published = as_published
        self.accepted: Accepted | None = None  # the CONNACK of a broker that accepted us
        self._accepted_at = 0.0
        self.where, self._settings = where, settings
        self._refusal: Refused | None = None
        self.reason = ""  # why the broker closed the connection, as its DISCONNECT says
        self.may_concern_message = False  # the reason may be a message of ours
        self._may_be_taken_over = True  # by a client with our id; only a DISCONNECT of MQTT 5 can exclude it
        self.messages: list[Message] = []  # read, and not delivered yet
        self.answers: dict[str, bool] = {}  # new answers: filters, each refused or not
        self.more = False  # a batch ended before the socket was empty
        self._left = 0  # bytes of whole packets that were received, and are not read yet
        self.age = ReadAge(self.answered_at)
        self.pings = Pings(settings, in_flight, self.age)
        self._packets = 0  # received so far
        self._owner, self._counters, self._in_flight = owner, counters, in_flight

    # -- called by the connection

    def check_silence(self, now: float) -> None:
        """Raise Silent if the broker has not answered for `pings.silence_limit_s`, which is never below `silence_s`."""
        if self.accepted is None:
            return  # `connect` has its own deadline, and gives the first round trip
        silent_s = now - max(self.answered_at, self.age.arriving_at)
        if silent_s > self.silence_s and silent_s > (limit := self.pings.silence_limit_s):
            self._counters.add("silences")
            raise Silent(f"{self.where} has not answered for {limit:.1f} s")

    def read(self, client: Client, now: float) -> None:
        """Read up to a batch of packets, piece by piece. ``now``: a time before anything is read. Raises Lost.

        Several pieces may have come, and TLS unpacks one after the other.
        """
        age, began_with, size = self.age, self._packets, 0
        while (packets_left := began_with + _BATCH - self._packets) > 0:
            packets_before = self._packets
            size += self._read_piece(client, now, packets_left)
            if not self.more or self._packets == packets_before:  # no packet has ended: the next call goes on
                break
            now = clock.since_boot()
        if size and self.pings.is_thin:  # any sign of life counts: answers wait behind messages of others
            self.answered_at = clock.since_boot()
        is_inside_packet = size > 0 and self._packets == began_with  # bytes came, but no end of a packet
        if age.has_retained or is_inside_packet:  # the broker is not silent: answers come after these
            age.note_arriving()
        if not self.more:
            age.waiting.empty(age.received_at)  # everything was read that had come by then

    def _read_piece(self, client: Client, now: float, most: int) -> int:
        """Read up to ``most`` packets from the bytes left over, or else from the socket; return how many bytes.

        Afterwards `more` is True if there may be more packets. Raises Lost.
        """
        unread = self._left
        if not unread:
            unread = self._receive(client, now)
        self.age.update(now, client.socket)
        try:
            self._left = bytes_left = client.read(most)
        except MalformedError as error:
            raise Lost(f"{self.where} does not speak MQTT: {error}") from None
        if self._refusal is not None:
            raise self._refusal
        if self.reason:
            client.close()
        self.more = bytes_left > 0 or not client.drained
        if self.more:  # else `Incoming.read` notes that the socket is empty
            self.age.waiting.read(unread - bytes_left)
        return unread - bytes_left

    def _receive(self, client: Client, now: float) -> int:
        """Read once from the socket; return the number of bytes, from which the ages of messages are estimated."""
        age, waiting = self.age, self.age.waiting  # waiting: since when bytes may have been in the socket
        age.received_at = now
        if now - waiting.checked_at > OVERSLEPT_S and self.accepted is not None:  # no pings before the CONNACK
            self.pings.send_after_stall(client, now)
        size = client.receive()
        waiting.found(size if client.drained else size + readable_bytes(client.socket), now)  # and what is left there
        return size

    @property
    def answered_s(self) -> float | None:
        """Seconds from the broker's CONNACK to its newest answer; None without a CONNACK."""
        return None if self.accepted is None else self.answered_at - self._accepted_at

    @property
    def lost(self) -> Lost:
        """Error for a connection that the other side has closed, with the reason."""
        why = self.reason or f"{self.where} closed the connection"
        client_id = self._settings.client_id
        if client_id is not None and self.accepted is not None and self._may_be_taken_over:
            why += f' (does another client use the client id "{client_id}"? a broker lets in only the newest)'
        if filters := self._in_flight.asked:  # subscriptions without an answer, which may be the reason
            more = f" and {len(filters) - _SHOWN} more" if len(filters) > _SHOWN else ""
            why += f", asked to deliver {', '.join(filters[:_SHOWN])}{more}"
        return Lost(why)

    # -- called by the client

    def _note_answer(self) -> None:
        self._packets += 1
        self.answered_at = clock.since_boot()

    def _note_connack(self) -> None:
        started = self.answered_at
        self._note_answer()
        self._in_flight.measured(self.answered_at - started)
        self.age.delay.usual(self.answered_at - started)

    def on_accepted(self, accepted: Accepted) -> None:
        self._note_connack()
        self.pings.begin(self.answered_at)
        self.accepted, self._accepted_at = accepted, self.answered_at

    def on_refused(self, code: int) -> None:
        self._note_connack()
        refused = f"{self.where} refused us: "
        if code == reasons.PROTOCOL_REFUSED and self._settings.protocol != "5":
            self._refusal = Refused(refused + Result.PROTOCOL_REFUSED.value, Result.PROTOCOL_REFUSED)
        else:
            self._refusal = Refused(refused + reasons.connection_refused(code), _LACKS.get(code, Result.FAILED))

    def on_disconnect(self, code: int) -> None:
        self.reason = f"{self.where} closed the connection: {reasons.words(code)}"
        self._may_be_taken_over = code == reasons.TAKEN_OVER
        self.may_concern_message = reasons.may_concern_message(code)

    def on_pong(self) -> None:
        self._note_answer()
        self._in_flight.pong(self.answered_at)
        self.age.delay.answered(self.answered_at)

    def on_answer(self, mid: int, codes: bytes) -> None:  # a SUBACK or UNSUBACK, see packets.Listener
        self._note_answer()
        answers = list(zip(self._in_flight.answer(mid), codes, strict=False))
        self.answers.update((filter_, code >= reasons.FAILURE) for filter_, code in answers)
        refused = [f"{filter_} ({reasons.words(code)})" for filter_, code in answers if code >= reasons.FAILURE]
        if refused:
            self._counters.add("subscriptions_refused")
            log.warning("%s refused to subscribe us to %s", self.where, ", ".join(refused))

    def on_puback(self, mid: int, code: int) -> None:
        now = clock.since_boot()
        if code >= reasons.FAILURE and (topic := self._in_flight.topic_of(mid)) is not None:
            self._counters.add("publications_refused")
            self._owner.note_refusal(topic, reasons.words(code))
        sent_at = self._in_flight.acknowledge(mid, now)
        if sent_at is not None:
            self._packets += 1
            self.answered_at = now
            self.age.delay.acknowledged(sent_at, now)

    def on_publication(self, topic: bytes, payload: bytes, first: int) -> None:
        """Make a message of a PUBLISH packet, with its age, and keep it for delivery. Must be fast."""
        age, retain = self.age, bool(first & RETAIN)
        if retain:
            age.has_retained = True
        if len(topic) > MAX_BYTES:  # no transport carries such topics, and their number has no bound
            self.on_too_long(topic, len(topic) + len(payload))
            return
        self._packets += 1
        try:
            text = topic.decode()
        except UnicodeDecodeError:
            self._counters.add("malformed")
            return
        retain_requested: bool | None = retain
        if not retain and not self.as_published:
            retain_requested = None  # the broker hides it
        qos = QoS.DELIVERED if first & ANY_QOS else QoS.LATEST
        self.messages.append(Message(text, payload, qos, retain, retain_requested, age.since))

    def skips(self, topic: bytes) -> bool:  # if True, it counts the packet itself: `on_publication` is not called
        if self.messages:
            return False  # these are to be delivered first: they may change the answer
        try:
            skipped = self._owner.policy.skips_retained(topic)
        except Exception:  # foreign code on our thread
            log.exception("asking whether to skip a retained message of %r failed", topic)
            return False
        if skipped:
            self._packets += 1
            self.age.note_arriving()
        return skipped

    def on_too_long(self, topic: bytes, length: int) -> None:
        self._packets += 1
        self._counters.add("too_long")
        log.debug("%s sent %d bytes on %r…: discarded", self.where, length, topic[:_LOGGED])
