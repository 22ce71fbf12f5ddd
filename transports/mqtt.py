"""The MQTT transport: one client of a broker, 3.1.1 or 5, kept connected by one thread of its own."""

from __future__ import annotations

import logging
import random
import ssl
import threading
import time
from collections.abc import Callable
from math import ceil

from pebble.errors import TransportError
from pebble.transports.base import Message, QoS, State, Subscription, Transport
from pebble.transports.mqtt_as_published import AsPublished
from pebble.transports.mqtt_connection import Connection, Lost, Refused, Silent, ignore
from pebble.transports.mqtt_filters import BrokerFilters, overlap
from pebble.transports.mqtt_ledger import Ticket
from pebble.transports.mqtt_tls import make_context
from pebble.transports.outgoing import Outgoing
from pebble.transports.settings import MqttSettings

log = logging.getLogger(__name__)

_ANSWER_S = 2.0  # longest wait for a SUBACK, and for the kept copies after it
_GOODBYE_S = 1.0  # longest wait for what a polite close still has to deliver
_DIALLING_S = 0.2  # longest wait for a thread that may be in connect(2)
_RETRY_S = 0.05  # second attempt to connect; doubles up to settings.reconnect_max_s
_CATCH_UP_S = 0.5  # for a broker that stood still to get through what others have sent it meanwhile
_STEADY_S = 2.0  # a connection that lived this long earns an immediate first retry
_REPEAT_LOG_S = 30.0  # between two log lines that say the same
_IDLE_S = 60.0  # the connection wakes earlier, for its pings
_REFUSALS = 2  # of bridge mode in a row, before we believe the broker does not have it


class MqttTransport(Transport):
    """See docs/transports.md for how it keeps each promise."""

    def __init__(self, client_id: str, settings: MqttSettings, *, will: Message | None = None) -> None:
        super().__init__(client_id, will=will)
        if settings.protocol not in ("3.1.1", "5"):
            raise TransportError(f'protocol must be "3.1.1" or "5", not "{settings.protocol}"')
        self.settings = settings
        self.as_published = settings.as_published
        self.exact_echo = settings.as_published or settings.protocol == "5"
        self._context: ssl.SSLContext | None = None
        self._attempt: Connection | None = None  # the newest connection, whatever became of it so far
        self._connection: Connection | None = None  # the same, from when it can be used
        self._routing = threading.RLock()  # guards the broker's filters, and which connection knows them
        self._filters = BrokerFilters()
        self._stopping = threading.Event()
        self._goodbye: Message | None = None
        self._thread: threading.Thread | None = None
        self._refusals = 0
        self._stood_still = False  # the broker may have, and have old messages to hand out first
        self._logged = ("", 0.0)  # the newest problem in the log, and when it went there
        self._memory = AsPublished()

    @property
    def outgoing(self) -> Outgoing:
        connection = self._connection
        return Outgoing() if connection is None else connection.outgoing

    # -- the interface to base

    def _open(self, timeout: float) -> None:  # noqa: ARG002  (base waits)
        if self.settings.tls is not None:
            self._context = make_context(self.settings.tls)
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(_ANSWER_S)  # closed while it was dialling
        self._goodbye = None
        self._stopping = stopping = threading.Event()
        self._thread = threading.Thread(
            target=self._run, args=(stopping,), name=f"pebble-mqtt {self.client_id}", daemon=True
        )
        self._thread.start()

    def _close(self, will: Message | None) -> None:
        """A thread in the middle of dialling is not waited for: it ends by itself, within CONNECT_TIMEOUT_S."""
        self._goodbye = will
        self._stopping.set()
        attempt = self._attempt
        if attempt is not None:
            attempt.wake()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(_DIALLING_S if attempt is None or attempt.dialling else _GOODBYE_S + _ANSWER_S)

    def _send(self, message: Message, urgent: bool) -> bool:
        connection = self._connection
        if connection is None or not (self._state is State.CONNECTED or self._announcing):
            return False
        expires_s = ceil(self.settings.silence_s) if urgent and not message.retain else None
        if message.retain:
            self._memory.say(message)
        return connection.publish(message, expires_s=expires_s)

    def _declare(self, subscription: Subscription) -> None:
        with self._routing:
            filter_, replaced = self._filters.add(subscription.filter)
            connection = self._connection
            if connection is None:
                return  # the next connection will ask for it
            self._memory.subscribe_again(filter_)
            asked = connection.subscribe([(filter_, self._quiet(filter_))])
            # Kept copies come after the SUBACK, over a bad link long after it; the answer to a ping follows them.
            tickets = [asked, connection.unsubscribe(replaced), connection.ping()]
        if threading.current_thread() is not self._thread:
            deadline = time.monotonic() + _ANSWER_S
            for ticket in tickets:
                ticket.wait(deadline - time.monotonic())

    def _undeclare(self, subscription: Subscription) -> None:  # noqa: ARG002  (the ones that stay decide)
        with self._routing:
            with self._lock:
                wanted = [other.filter for other in self._subscriptions]
            idle = self._filters.prune(wanted)
            if self._connection is not None:
                self._connection.unsubscribe(idle)

    def _quiet(self, filter_: str) -> bool:
        """May the broker leave out our own messages for this filter (MQTT 5)?"""
        with self._lock:
            echoes = {other.echo for other in self._subscriptions if overlap(other.filter, filter_)}
        if len(echoes) == 2 and self.exact_echo:
            self.exact_echo = False
            log.warning("%s: subscriptions with and without echo overlap in %s: both echo", self.client_id, filter_)
        return echoes == {False}

    # -- the network thread

    def _run(self, stopping: threading.Event) -> None:
        failures = 0
        while not stopping.is_set():
            began = time.monotonic()
            try:
                self._live(stopping)
            except Lost as lost:
                self._stood_still |= isinstance(lost, Silent)
                if not stopping.is_set():
                    self._complain(str(lost))
            except Exception:  # the thread's last line of defence: a transport that is deaf for good is worse
                log.exception("%s: the connection failed in a way nobody thought of", self.client_id)
            if stopping.is_set():
                return
            if self._state is State.CONNECTED and time.monotonic() - began > _STEADY_S:
                failures = 0
            self._set_state(State.CONNECTING)
            pause = min(self.settings.reconnect_max_s, _RETRY_S * 2 ** (failures - 1)) if failures else 0.0
            failures = min(failures + 1, 20)
            stopping.wait(pause * random.uniform(0.5, 1.0))  # noqa: S311  (jitter, no secret)

    def _live(self, stopping: threading.Event) -> None:
        """One connection, from its start to its end; raises Lost unless the end is our own polite one."""
        connection = self._attempt = self._make_connection()
        try:
            self._connect(connection, stopping)
            self._begin(connection, stopping)
            while not stopping.is_set():
                connection.pump(_IDLE_S, self._dispatch)
                if self._parked and connection.has_room:
                    self._announce(self._own.keys())
            self._say_goodbye(connection)
        finally:
            with self._routing:
                self._connection = None
            connection.discard()
            self._repark(connection)

    def _make_connection(self) -> Connection:
        as_published = self.settings.as_published and self._refusals < _REFUSALS
        return Connection(
            self.client_id, self.settings, self._context, self.will, self.counters, as_published=as_published
        )

    def _connect(self, connection: Connection, stopping: threading.Event) -> None:
        try:
            connection.connect(stopping)
        except Lost as lost:
            bridge = connection.as_published and self.settings.protocol == "3.1.1"
            self._refusals = self._refusals + 1 if bridge and isinstance(lost, Refused) else 0
            raise
        if self.settings.as_published:
            self._refusals = 0
            if self.as_published and not connection.as_published:
                log.warning("%s has no bridge mode: own messages come back on this connection", connection.where)
            self.as_published = self.exact_echo = connection.as_published

    def _begin(self, connection: Connection, stopping: threading.Event) -> None:
        """Find out what the broker still has of ours, subscribe, and send what it lacks."""
        self._renew()
        self._memory.begin()
        if self._stood_still or connection.hesitated:
            self._let_catch_up(connection, stopping)
        known = self._ask_for_own(connection, stopping)
        with self._routing:
            self._connection = connection
            subscribed = connection.subscribe([(filter_, self._quiet(filter_)) for filter_ in self._filters])
            copied = connection.ping()
        self._await(connection, subscribed, stopping, self._dispatch)
        self._await(connection, copied, stopping, self._dispatch)
        self._settle_in(known)

    def _let_catch_up(self, connection: Connection, stopping: threading.Event) -> None:
        """Before we subscribe: a broker that wakes up finds what others typed while it slept, and would pass it on."""
        end = time.monotonic() + _CATCH_UP_S
        while not stopping.is_set() and (left := end - time.monotonic()) > 0:
            connection.pump(left, ignore)
        self._stood_still = False

    def _ask_for_own(self, connection: Connection, stopping: threading.Event) -> set[str]:
        """Topics of ours whose kept copy the broker has. A ping's answer comes after the copies (sent with QoS 0)."""
        with self._publishing:
            topics = [topic for topic in self._own if topic not in self._parked]
        if not topics:
            return set()
        connection.subscribe([(topic, False) for topic in topics], QoS.LATEST)
        found: dict[str, bytes] = {}

        def note(messages: list[Message]) -> None:
            found.update((message.topic, message.payload) for message in messages if message.retain)

        self._await(connection, connection.ping(), stopping, note)
        connection.unsubscribe(topics)
        if self.will is not None and found.get(self.will.topic) == self.will.payload:
            del found[self.will.topic]  # our own will, spoken by mistake: we live
        return set(found)

    def _await(
        self,
        connection: Connection,
        ticket: Ticket,
        stopping: threading.Event,
        receive: Callable[[list[Message]], None],
    ) -> None:
        deadline = time.monotonic() + _ANSWER_S
        while not ticket.done:
            if stopping.is_set():
                raise Lost("closed")
            if time.monotonic() > deadline:
                raise Silent(f"{connection.where} does not answer")
            connection.pump(deadline - time.monotonic(), receive)

    def _dispatch(self, messages: list[Message]) -> None:
        for message in messages:
            self.counters.add("received")
            repeat = False
            if message.retain and self.as_published:
                if self._memory.is_echo(message):
                    self.counters.add("echoes")
                    continue
                repeat = self._memory.is_repeat(message)
            for subscription in self._matching(message.topic):
                subscription.offer(message, repeat=repeat)

    def _say_goodbye(self, connection: Connection) -> None:
        """Will, then what is still on its way, then DISCONNECT: bounded."""
        if self._goodbye is not None:
            connection.publish(self._goodbye)
        last = connection.ping()
        deadline = time.monotonic() + _GOODBYE_S
        while time.monotonic() < deadline and not (last.done and connection.quiet):
            connection.pump(deadline - time.monotonic(), ignore)
        connection.disconnect()

    def _repark(self, connection: Connection) -> None:
        """Kept messages the broker may never have got count as changed while away."""
        self.counters.add("unconfirmed", connection.unacked)
        with self._publishing:
            for message in connection.unproven():
                if message.topic not in self._parked:
                    self._remember(message, told=False)

    def _complain(self, problem: str) -> None:
        self.problem = problem
        now = time.monotonic()
        if problem != self._logged[0] or now - self._logged[1] > _REPEAT_LOG_S:
            self._logged = (problem, now)
            log.warning("%s: %s", self.client_id, problem)
