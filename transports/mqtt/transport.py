"""The MQTT transport: one client of a broker, 3.1.1 or 5, with one thread that keeps it connected."""

from __future__ import annotations

import logging
import random
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from math import ceil
from typing import ClassVar

from pebble.errors import TransportError
from pebble.transports import clock
from pebble.transports.base import Answer, Message, Outgoing, QoS, State, Subscription, Transport
from pebble.transports.mqtt.client import Client
from pebble.transports.mqtt.connection import Connection, ignore
from pebble.transports.mqtt.dialler import Dialler
from pebble.transports.mqtt.ending import Lost, Silent
from pebble.transports.mqtt.filters import BrokerFilters, OwnMessageFilter, overlap
from pebble.transports.mqtt.outgoing import PendingAck
from pebble.transports.mqtt.refused_topics import RefusedTopics
from pebble.transports.settings import MqttSettings

log = logging.getLogger(__name__)

_ANSWER_S = 2.0  # longest wait for a SUBACK, and for the retained messages after it
_CLOSING_S = 1.0  # longest wait for unacknowledged messages when closing
_DIALLING_S = 0.2  # longest wait for a thread that may be in connect(2)
_RETRY_S = 0.05  # second attempt to connect; doubles up to settings.reconnect_max_s
_CATCH_UP_S = 0.5  # time for a broker that was suspended to deliver its backlog before we subscribe
_STEADY_S = 2.0  # after a connection this long the first retry is immediate
_REPEAT_LOG_S = 30.0  # between two equal log lines
_TRIED_S = 1.0  # after which a connection shows what the broker has
_IDLE_S = 60.0  # the connection wakes up earlier, for its pings


class _Run:
    """A run of the network thread, with the requests of other threads to it."""

    def __init__(self, target: Callable[[_Run], None], name: str) -> None:
        self.stopping = threading.Event()
        self.will: Message | None = None  # to publish when it stops
        self.renewal = ""  # why the connection is to be made anew
        self.thread = threading.Thread(target=target, args=(self,), name=name, daemon=True)

    def join(self, timeout: float) -> None:
        """Wait for the end of the thread, unless the caller runs on it."""
        if self.thread is not threading.current_thread():
            self.thread.join(timeout)


class MqttTransport(Transport):
    """A client of an MQTT broker; docs/transports.md explains how it implements each promise."""

    client_class: ClassVar[type[Client]] = Client

    def __init__(self, client_id: str, settings: MqttSettings, *, will: Message | None = None) -> None:
        super().__init__(client_id, will=will)
        if settings.protocol not in ("3.1.1", "5"):
            raise TransportError(f'protocol must be "3.1.1" or "5", not "{settings.protocol}"')
        self.settings = settings
        self.as_published = settings.as_published  # on 3.1.1 by bridge mode, which also keeps our own messages away
        self.exact_echo = settings.as_published or settings.protocol == "5"  # by bridge mode, or by noLocal of 5
        self._dialler = Dialler(client_id, settings, will, self.client_class)
        self._connection: Connection | None = None  # the newest one, once it can be used
        self._filters = BrokerFilters()
        self._own_message_filter = OwnMessageFilter()
        self._network: _Run | None = None  # the newest run of the network thread
        self._refused = RefusedTopics(client_id, settings.vital)
        self._logged = ("", 0.0)  # the newest problem in the log, and when it went there

    @property
    def untried(self) -> bool:
        return self._dialler.addresses.untried

    @property
    def outgoing(self) -> Outgoing:
        connection = self._connection
        return Outgoing() if connection is None else connection.outgoing

    @property
    def answer(self) -> Answer | None:
        connection = self._connection
        return None if connection is None else connection.answer

    def suit_link(self, *, thin: bool) -> None:
        super().suit_link(thin=thin)
        attempt = self._dialler.attempt
        if attempt is not None:
            attempt.suit(thin=thin)

    def renew_connection(self, why: str) -> None:
        run, connection = self._network, self._connection
        if run is not None:
            run.renewal = why
        if connection is not None:
            connection.wake()

    # -- the interface to base

    def _open(self, timeout: float) -> None:  # noqa: ARG002  (base waits)
        self._dialler.open()
        if self._network is not None:
            self._network.join(_ANSWER_S)  # closed while it was dialling
        self._network = _Run(self._run, f"pebble-mqtt {self.client_id}")
        self._network.thread.start()

    def _close(self, will: Message | None) -> None:
        """End the network thread. If it is connecting, do not wait: it ends by itself within HANDSHAKE_S."""
        run = self._network
        if run is None:
            return
        run.will = will
        run.stopping.set()
        attempt = self._dialler.attempt
        if attempt is not None:
            attempt.wake()
        run.join(_DIALLING_S if attempt is None or attempt.dialling else _CLOSING_S + _ANSWER_S)

    def _send(self, message: Message, urgent: bool) -> bool:
        connection = self._connection
        if connection is None or not (self._state is State.CONNECTED or self._own.syncing):  # see `_initial_sync`
            return False
        if not connection.takes(message):
            why = f"{len(message.payload)} bytes, but it takes packets of {connection.max_packet} at most"
            self._refused.report(connection.where, message.topic, why, time.monotonic(), logging.ERROR)
            self.counters.add("too_large")
            return True  # as if it were sent: nothing may wait behind it
        if self._refused.withheld and not self._refused.admits(message, time.monotonic()):
            self.counters.add("withheld")
            return True  # here, too
        expires_s = ceil(self.settings.silence_s) if urgent and not message.retain else None  # later it is stale
        if message.retain:
            self._own_message_filter.note_own(message)
        return connection.publish(message, expires_s=expires_s)

    def _declare(self, subscription: Subscription) -> None:
        self._declare_all([subscription])

    def _declare_all(self, subscriptions: Sequence[Subscription]) -> None:
        acks = []
        with self._filters.lock:
            connection = self._connection
            for subscription in subscriptions:
                filter_, replaced = self._filters.add(subscription.filter)  # a wider filter may replace others
                if connection is not None:
                    self._own_message_filter.subscribe_again(filter_)  # retained messages are sent once more
                    acks.append(connection.subscribe([(filter_, self._no_local(filter_))]))
                    acks.append(connection.unsubscribe(replaced))
            if connection is None:
                return  # the next connection subscribes to them
            # Retained messages come after the SUBACK, on a bad network long after it; a ping's answer follows them.
            acks.append(connection.ping())
        if self._network is None or threading.current_thread() is not self._network.thread:  # which reads the answers
            deadline = time.monotonic() + _ANSWER_S
            for ack in acks:
                ack.wait(deadline - time.monotonic())

    def ask(self, topics: Collection[str]) -> None:  # see Transport.ask: subscribes to each of them for a moment
        deadline = time.monotonic() + _ANSWER_S
        with self._filters.lock:
            connection, unheard = self._connection, [topic for topic in topics if topic not in self._filters]
            if connection is None or not unheard:
                return
            for topic in unheard:
                self._own_message_filter.subscribe_again(topic)  # its retained message comes once more
            # Retained messages come after the SUBACK, to all subscriptions that match; the ping's answer follows them.
            answer = connection.subscribe([(topic, self._no_local(topic)) for topic in unheard], QoS.LATEST)
            acks = [answer, connection.ping(), connection.unsubscribe(unheard)]
        for ack in acks:
            ack.wait(deadline - time.monotonic())

    def _undeclare(self, subscription: Subscription) -> None:
        with self._filters.lock:
            idle = self._filters.prune(subscription.filter, [other.filter for other in self._subscriptions])
            if self._connection is not None:
                self._connection.unsubscribe(idle)

    def _no_local(self, filter_: str) -> bool:
        """True if the broker may leave out our own messages for this filter (MQTT 5)."""
        echo_options = {other.echo for other in self._subscriptions if overlap(other.filter, filter_)}
        if len(echo_options) == 2 and self.exact_echo:
            self.exact_echo = False
            log.warning("%s: subscriptions with and without echo overlap in %s: both echo", self.client_id, filter_)
        return echo_options == {False}

    # -- the network thread

    def _run(self, run: _Run) -> None:
        failures, stopping = 0, run.stopping  # failures in a row without the newest: there is no pause after the first
        while not stopping.is_set():
            began, problem = time.monotonic(), "failed unexpectedly"
            try:
                self._run_connection(run)
            except Lost as lost:
                self._note_end(lost)
                problem = str(lost)
            except Exception:  # any error must lead to a reconnect, never end the thread
                log.exception("%s: unexpected failure of the connection", self.client_id)
            if stopping.is_set():
                return
            held_s = time.monotonic() - began if self._state is State.CONNECTED else 0.0
            problem, is_to_be_logged = self._dialler.failed(problem, held_s)
            if problem:
                self.problem = problem
            if is_to_be_logged:
                self._log(logging.WARNING, problem)
            if held_s > _STEADY_S:
                failures = 0
            self._set_state(State.CONNECTING)
            if self._dialler.addresses.several and not self._dialler.addresses.is_over:
                continue  # the next address
            pause = min(self.settings.reconnect_max_s, _RETRY_S * 2 ** (failures - 1)) if failures else 0.0
            if not self._dialler.limits.asks_again:  # else it is asked in another way at once: no failure yet
                failures = min(failures + 1, 20)  # bounded, because it is an exponent
            stopping.wait(pause * random.uniform(0.5, 1.0))  # noqa: S311  (jitter, no secret)

    def _note_end(self, lost: Lost) -> None:
        """Note what the end of a connection, or of an attempt, tells about the broker and the way there."""
        connected = self._state is State.CONNECTED
        self.was_ended = self._dialler.is_gone(lost, connected=connected, was_ended=self.was_ended)
        if self._dialler.note_end(lost):
            text = "the way there seems to lose large packets (a wrong MTU?): from now on they are small"
            log.warning("%s: %s: %s", self.client_id, self._dialler.addresses.where, text)

    def _run_connection(self, run: _Run) -> None:
        """Run one connection from its start to its end. Raises Lost unless `close` has ended it."""
        self._dialler.begin()
        connection = self._dialler.connect(self, self.counters, run.stopping)
        run.renewal = ""  # if it was requested before, this connection is the new one
        connection.suit(thin=self.is_thin)
        try:
            if self.settings.as_published:
                is_granted = connection.incoming.as_published
                if self.as_published and not is_granted:  # logged once, until it is granted again
                    log.warning("%s has no bridge mode: own messages come back on this connection", connection.where)
                self.as_published = self.exact_echo = is_granted  # if not, own messages come back: no exact echo
            self._serve(connection, run)
            self._finish(connection, run.will)
        finally:
            with self._filters.lock:
                self._connection = None
            connection.discard()
            self._keep_unconfirmed(connection)

    def _serve(self, connection: Connection, run: _Run) -> None:
        tried_at = time.monotonic() + _TRIED_S  # a connection that ends sooner does not prove the broker's limits
        try:
            self._synchronize(connection, run.stopping)
            if earlier_failures := self._dialler.addresses.succeeded():
                self._log(logging.INFO, f"connected to {connection.where}; before it {earlier_failures}")
            while not run.stopping.is_set():
                connection.pump(_IDLE_S, self._deliver_all)
                if run.renewal:  # see renew_connection
                    connection.disconnect()
                    raise Lost(run.renewal)
                if connection.limits is not self._dialler.reported and time.monotonic() > tried_at:  # not logged yet
                    self._report_limits(connection)
                if self._own.pending and connection.has_room:  # retained messages that were not sent yet
                    self._sync_retained(self._own.keys())
                if self._refused.withheld:  # topics that are not sent, as the broker hangs up on them
                    self._try_withheld(connection)
                for topic in self._refused.refused_due(time.monotonic()):
                    self._send_refused(topic)
        except Lost as lost:
            self._note_loss(connection, lost)
            raise

    def _note_loss(self, connection: Connection, lost: Lost) -> None:
        """Note the messages for which the broker may have closed the connection."""
        written = None if isinstance(lost, Silent) else connection.written_before_loss()
        if self.will is None:
            never_acked = written is not None and connection.in_flight.never_acked
            self._dialler.limits.note_loss(never_acked=never_acked, now=time.monotonic())
        with self._publishing:
            self._refused.note_loss(connection.where, written, time.monotonic())

    def _try_withheld(self, connection: Connection) -> None:
        """Send retained messages that were withheld, where a new attempt is due: the broker may refuse their topics."""
        with self._publishing:
            for message in self._refused.due(self._own, connection.where, time.monotonic()):
                self._own.remember(message, sent=self._send(message, False))  # not urgent

    def _send_refused(self, topic: str) -> None:
        """Send our retained message of a topic again, unless others publish there, too: theirs may be newer."""
        with self._publishing:
            if (message := self._own.get(topic)) is not None and topic not in self._own.shared:
                self._own.remember(message, sent=self._send(message, False))

    def _report_limits(self, connection: Connection) -> None:
        limits = connection.limits
        if limits.losses and limits != self._dialler.reported:
            level = logging.WARNING if self.will is not None or self._own else logging.INFO  # it loses nothing
            log.log(level, "%s: %s %s", self.client_id, connection.where, limits.losses)
        self._dialler.reported = limits

    def _synchronize(self, connection: Connection, stopping: threading.Event) -> None:
        """Ask which of our retained messages the broker has, subscribe, and send those that it lacks."""
        self._renew()  # all subscriptions: retained messages are delivered again
        self._own_message_filter.begin()
        if self._dialler.stalled:  # the broker may have been suspended
            self._let_catch_up(connection, stopping)
        known_topics = self._query_own(connection, stopping)
        with self._filters.lock:
            self._connection = connection
            subscribed = connection.subscribe([(filter_, self._no_local(filter_)) for filter_ in self._filters])
            after_retained = connection.ping()  # its answer follows the retained messages
        self._await(connection, subscribed, stopping, self._deliver_all)
        self._await(connection, after_retained, stopping, self._deliver_all)
        self._initial_sync(known_topics)

    def _let_catch_up(self, connection: Connection, stopping: threading.Event) -> None:
        """Wait before subscribing, because a broker that was suspended first forwards old messages of others."""
        end = time.monotonic() + _CATCH_UP_S
        while not stopping.is_set() and (remaining_s := end - time.monotonic()) > 0:
            connection.pump(remaining_s, ignore)
        self._dialler.stalled = False

    def _query_own(self, connection: Connection, stopping: threading.Event) -> set[str]:
        """Return the topics of our retained messages that are not sent again: the broker has ours, or may have another.

        Sets ``went_back`` if it has another value on a topic that only we publish on: an older one. All values have
        arrived when a ping is answered, because they have QoS 0.
        """
        self.went_back = False
        with self._publishing:
            messages = {topic: message for topic, message in self._own.items() if topic not in self._own.pending}
            not_accepted = {topic for topic, message in messages.items() if not self._accepts(connection, message)}
            may_differ = self._own.shared | not_accepted  # others publish there, too, or the broker refuses ours
        retained = self._find(connection, list(messages), stopping)
        if self.will is not None and retained.get(self.will.topic) == self.will.payload:
            del retained[self.will.topic]  # our own will, published although we were running
        differing = {topic for topic, payload in retained.items() if payload != messages[topic].payload}
        older = differing - may_differ
        self.went_back = bool(older)
        return retained.keys() - older  # without older ones, as ours replace them

    def _find(self, connection: Connection, topics: list[str], stopping: threading.Event) -> dict[str, bytes]:
        """Return the payloads that the broker retains on these topics."""
        retained: dict[str, bytes] = {}
        if not topics:
            return retained
        connection.subscribe([(topic, False) for topic in topics], QoS.LATEST)  # False: no noLocal, as they are ours

        def note(messages: list[Message]) -> None:
            for message in messages:
                if message.retain and message.topic in topics:
                    retained[message.topic] = message.payload

        self._await(connection, connection.ping(), stopping, note)
        connection.unsubscribe(topics)
        return retained

    def _accepts(self, connection: Connection, message: Message) -> bool:
        """True if the broker accepts this retained message, as far as is known."""
        return connection.takes(message) and self._refused.accepts(message)

    def _await(
        self,
        connection: Connection,
        ack: PendingAck,
        stopping: threading.Event,
        receive: Callable[[list[Message]], None],
    ) -> None:
        """Run the connection until ``ack`` is done; ``receive`` gets the messages. Raises Lost, also when closing."""
        asked_at = clock.since_boot()
        while not ack.is_set():
            if stopping.is_set():
                raise Lost("closed")
            # The wait begins again while retained messages arrive, and on a thin link with every sign of life.
            since, answer_s = max(asked_at, connection.incoming.age.arriving_at), _ANSWER_S
            if connection.pings.is_thin:
                since, answer_s = max(since, connection.incoming.answered_at), connection.pings.silence_limit_s
            remaining_s = since + answer_s - clock.since_boot()
            if remaining_s < 0:
                raise Silent(f"{connection.where} does not answer")
            connection.pump(remaining_s, receive)

    def _deliver_all(self, messages: list[Message]) -> None:
        subscriptions = self._subscriptions
        for message in messages:
            self.count_received()
            repeat = False  # True: it was delivered before, and came again because we subscribed again
            if message.retain and self.as_published:
                if self._own_message_filter.is_echo(message):
                    self.counters.add("echoes")
                    continue
                repeat = self._own_message_filter.is_repeat(message)
            for subscription in subscriptions.matched.get(message.topic) or subscriptions.matching(message.topic):
                subscription.offer(message, repeat=repeat)

    def note_answers(self, refused: Mapping[str, bool]) -> None:  # see Owner: by filter, True if it is refused
        if self._connection is None:
            return  # these answer `_find`, which asks before the connection is used
        subscriptions = list(self._subscriptions)
        for filter_, is_refused in refused.items():
            for subscription in subscriptions:
                if overlap(subscription.filter, filter_):  # then it is the broker's filter that covers the subscription
                    subscription.refused = is_refused

    def note_refusal(self, topic: str, why: str) -> None:
        self._refused.refuse(self._dialler.addresses.where, topic, why, time.monotonic())

    def _finish(self, connection: Connection, will: Message | None) -> None:
        """Publish the will, wait (bounded) until everything is acknowledged, then send DISCONNECT."""
        if will is not None:
            connection.publish(will)
        last = connection.ping()
        deadline = time.monotonic() + _CLOSING_S
        while time.monotonic() < deadline and not (last.is_set() and connection.drained):
            connection.pump(deadline - time.monotonic(), ignore)
        connection.disconnect()

    def _keep_unconfirmed(self, connection: Connection) -> None:
        """Mark retained messages that the broker may not have received as pending."""
        self.counters.add("unconfirmed", connection.in_flight.unacked)
        with self._publishing:
            for message in connection.unconfirmed_retained():
                if message.topic not in self._own.pending:
                    self._own.remember(message, sent=False)

    def _log(self, level: int, line: str) -> None:
        now = time.monotonic()
        if line != self._logged[0] or now - self._logged[1] > _REPEAT_LOG_S:
            self._logged = (line, now)
            log.log(level, "%s: %s", self.client_id, line)


TRANSPORT = MqttTransport
