"""The MQTT transport: one client of a broker, 3.1.1 or 5, with one thread that keeps it connected."""

from __future__ import annotations

import logging
import random
import threading
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from math import ceil, inf

from pebble.errors import TransportError
from pebble.transports import clock
from pebble.transports.base import Message, Outgoing, QoS, State, Subscription, Transport
from pebble.transports.bounds import BoundedTable
from pebble.transports.credentials import Credentials
from pebble.transports.hosts import Address, Turns
from pebble.transports.mqtt import client_ids
from pebble.transports.mqtt.bridge_mode import Attempt, BridgeMode, Result
from pebble.transports.mqtt.broker_limits import EVERYTHING, BrokerLimits, Limits
from pebble.transports.mqtt.client import Opening
from pebble.transports.mqtt.connection import Connection, client_class, ignore
from pebble.transports.mqtt.ending import Absent, Lost, Refused, Silent
from pebble.transports.mqtt.filters import BrokerFilters, OwnMessageFilter, overlap
from pebble.transports.mqtt.outgoing import PendingAck
from pebble.transports.mqtt.retention import RetentionCheck
from pebble.transports.mqtt.suspects import TOPICS, Kind, SuspectTopics, Written, is_large, named
from pebble.transports.settings import MqttSettings
from pebble.transports.topics import MAX_BYTES

log = logging.getLogger(__name__)

_ASKED = 8  # topics of one SUBSCRIBE: AWS IoT closes the connection for more
_ANSWER_S = 2.0  # longest wait for a SUBACK, and for the retained messages after it
_CLOSING_S = 1.0  # longest wait for unacknowledged messages when closing
_DIALLING_S = 0.2  # longest wait for a thread that may be in connect(2)
_RETRY_S = 0.05  # second attempt to connect; doubles up to settings.reconnect_max_s
_HESITATION_S = 0.5  # a CONNACK that takes longer comes over a very slow connection, or from a suspended broker
_CATCH_UP_S = 0.5  # time for a broker that was suspended to deliver its backlog before we subscribe
_ENDING_S = 1.0  # so long a broker that ends may still accept connections, and hang up on them
_STEADY_S = 2.0  # after a connection this long the first retry is immediate
_REPEAT_LOG_S = 30.0  # between two equal log lines
_TRY_S = 0.25  # between two looks whether a topic that is withheld may be tried
_NOT_TAKEN_S = 600.0  # between two log lines about one topic that the broker does not take
_TRIED_S = 1.0  # after which a connection shows what the broker has
_IDLE_S = 60.0  # the connection wakes up earlier, for its pings


class MqttTransport(Transport):
    """docs/transports.md explains how it implements each promise."""

    def __init__(self, client_id: str, settings: MqttSettings, *, will: Message | None = None) -> None:
        super().__init__(client_id, will=will)
        if settings.protocol not in ("3.1.1", "5"):
            raise TransportError(f'protocol must be "3.1.1" or "5", not "{settings.protocol}"')
        client_class(settings.client)  # a package that is missing is an error now, not in a thread
        self.settings = settings
        # It stays the same over reconnects: the broker closes our own half-dead connection at once.
        self._mqtt_client_id = client_ids.unique(client_id) if settings.client_id is None else settings.client_id
        self._broker = f"broker {settings.host}:{settings.port}"
        self._turns = Turns(settings.host, settings.port)
        self.as_published = settings.as_published
        self.exact_echo = settings.as_published or settings.protocol == "5"
        self._credentials: Credentials | None = None  # read when it opens
        self._attempt: Connection | None = None  # the newest connection, in any state
        self._connection: Connection | None = None  # the same, once it can be used
        self._routing = threading.RLock()  # guards the broker's filters, and the connection they belong to
        self._filters = BrokerFilters()
        self._stopping = threading.Event()
        self._will_on_close: Message | None = None
        self._thread: threading.Thread | None = None
        self._bridge_mode, self._limits = BridgeMode(), BrokerLimits()  # of the broker at this address:
        self._address: Address | None = None
        self._gone_at = float("-inf")  # when the broker was last known to be gone
        self._broker_stalled = False  # the broker may have been suspended, and have old messages to forward first
        self._logged = ("", 0.0)  # the newest problem in the log, and when it went there
        self._own_message_filter = OwnMessageFilter()
        self._suspects = SuspectTopics(settings.vital)  # guarded by _publishing
        self._tried_at = 0.0  # when it was last looked whether one of them may be tried
        self._arrived_at = float("-inf")  # the newest message
        self._checked: set[str] = set()  # addresses of brokers that were asked what they retain
        self._retention: RetentionCheck | None = None
        self._retention_answer = PendingAck()
        #: Topics on which the broker takes no messages: why, and when that was last in the log.
        self.not_taken = BoundedTable[tuple[str, float]](TOPICS, TOPICS * MAX_BYTES, lambda _: 0)
        self._reported = EVERYTHING  # what the log says the broker has

    @property
    def untried(self) -> bool:
        return self._turns.untried

    @property
    def outgoing(self) -> Outgoing:
        connection = self._connection
        return Outgoing() if connection is None else connection.outgoing

    # -- the interface to base

    def _open(self, timeout: float) -> None:  # noqa: ARG002  (base waits)
        self._credentials = Credentials(self.settings)
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(_ANSWER_S)  # closed while it was dialling
        self._will_on_close = None
        self._stopping = stopping = threading.Event()
        self._thread = threading.Thread(
            target=self._run, args=(stopping,), name=f"pebble-mqtt {self.client_id}", daemon=True
        )
        self._thread.start()

    def _close(self, will: Message | None) -> None:
        """Do not wait for a thread that is connecting: it ends by itself, within CONNECT_TIMEOUT_S."""
        self._will_on_close = will
        self._stopping.set()
        attempt = self._attempt
        if attempt is not None:
            attempt.wake()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(_DIALLING_S if attempt is None or attempt.dialling else _CLOSING_S + _ANSWER_S)

    def _send(self, message: Message, urgent: bool) -> bool:
        connection = self._connection
        if connection is None or not (self._state is State.CONNECTED or self._syncing):
            return False
        if not connection.takes(message):
            why = f"{len(message.payload)} bytes, but it takes packets of {connection.max_packet} at most"
            self._report_not_taken(connection.where, message.topic, why, logging.ERROR)
            self.counters.add("too_large")
            return True
        tried = False
        if self._suspects.withheld and not self._suspects.accepts(message):
            tried = self._suspects.tries(message, time.monotonic(), self._arrived_at)
            if not tried:
                self.counters.add("withheld")
                return True  # as if it were sent: nothing may wait behind it
            connection.pings.doubtful.add(message.topic)
        expires_s = ceil(self.settings.silence_s) if urgent and not message.retain else None
        if message.retain:
            self._own_message_filter.note_own(message)
        accepted = connection.publish(message, expires_s=expires_s)
        if tried and not accepted:
            self._suspects.give_up()
        return accepted

    def _declare(self, subscription: Subscription) -> None:
        with self._routing:
            filter_, replaced = self._filters.add(subscription.filter)
            connection = self._connection
            if connection is None:
                return  # the next connection subscribes to it
            self._own_message_filter.subscribe_again(filter_)
            asked = connection.subscribe([(filter_, self._no_local(filter_))])
            # Retained messages come after the SUBACK, on a bad network long after it; a ping's answer follows them.
            acks = [asked, connection.unsubscribe(replaced), connection.ping()]
        if threading.current_thread() is not self._thread:
            deadline = time.monotonic() + _ANSWER_S
            for ack in acks:
                ack.wait(deadline - time.monotonic())

    def ask(self, topics: Collection[str]) -> None:
        deadline, rest = time.monotonic() + _ANSWER_S, list(topics)
        while rest:
            asked, rest = rest[:_ASKED], rest[_ASKED:]
            for ack in self._ask(asked):
                ack.wait(deadline - time.monotonic())

    def _ask(self, topics: list[str]) -> list[PendingAck]:
        with self._routing:
            connection, names = self._connection, [topic for topic in topics if topic not in self._filters]
            if connection is None or not names:
                return []
            for name in names:
                self._own_message_filter.subscribe_again(name)
            asked = connection.subscribe([(name, self._no_local(name)) for name in names], QoS.LATEST)
            return [asked, connection.ping(), connection.unsubscribe(names)]

    def _undeclare(self, subscription: Subscription) -> None:  # noqa: ARG002  (the ones that stay decide)
        with self._routing:
            with self._lock:
                wanted = [other.filter for other in self._subscriptions]
            idle = self._filters.prune(wanted)
            if self._connection is not None:
                self._connection.unsubscribe(idle)

    def _no_local(self, filter_: str) -> bool:
        """Whether the broker may leave out our own messages for this filter (MQTT 5)."""
        with self._lock:
            echo_options = {other.echo for other in self._subscriptions if overlap(other.filter, filter_)}
        if len(echo_options) == 2 and self.exact_echo:
            self.exact_echo = False
            log.warning("%s: subscriptions with and without echo overlap in %s: both echo", self.client_id, filter_)
        return echo_options == {False}

    # -- the network thread

    def _run(self, stopping: threading.Event) -> None:
        failures = 0
        while not stopping.is_set():
            began, problem = time.monotonic(), "failed unexpectedly"
            try:
                self._run_connection(stopping)
            except Lost as lost:
                silent = isinstance(lost, Silent)  # then it may be we who stood still
                self._broker_stalled |= silent
                self._note_end(lost, silent=silent)
                problem = str(lost)
            except Exception:  # any error must lead to a reconnect, never end the thread
                log.exception("%s: unexpected failure of the connection", self.client_id)
            if stopping.is_set():
                return
            held_s = time.monotonic() - began if self._state is State.CONNECTED else 0.0
            self._note_failure(problem, held_s)
            if held_s > _STEADY_S:
                failures = 0
            self._set_state(State.CONNECTING)
            if self._turns.several and not self._turns.is_over:
                continue  # the next address
            pause = min(self.settings.reconnect_max_s, _RETRY_S * 2 ** (failures - 1)) if failures else 0.0
            if not self._limits.asks_again:
                failures = min(failures + 1, 20)
            stopping.wait(pause * random.uniform(0.5, 1.0))  # noqa: S311  (jitter, no secret)

    def _note_end(self, lost: Lost, *, silent: bool) -> None:
        """Whether the other end is gone: nothing listens, or it hangs up as one that is just ending does."""
        now = time.monotonic()
        if self._state is State.CONNECTED:
            self.was_ended, self._gone_at = not silent, now
        elif isinstance(lost, Absent):
            self._gone_at = now
        elif silent or now - self._gone_at > _ENDING_S:
            self.was_ended = False

    def _run_connection(self, stopping: threading.Event) -> None:
        """Run one connection from its start to its end; raises Lost unless it ends by `close`."""
        self._address = self._next_address()
        self._limits.begin(time.monotonic())
        if self._limits.wants_probe or (self._asks_for_bridge_mode and self._bridge_mode.next_attempt is Attempt.PROBE):
            self._probe(stopping)
        plain = self._asks_for_bridge_mode and self._bridge_mode.next_attempt is Attempt.PLAIN
        as_published = self.settings.as_published and not plain
        will = self._limits.limits.fit_will(self.will)
        connection = self._attempt = self._make_connection(will, as_published=as_published)
        try:
            self._connect(connection, stopping)
            self._serve(connection, stopping)
            self._finish(connection)
        finally:
            with self._routing:
                self._connection = None
            connection.discard()
            self._keep_unconfirmed(connection)

    def _next_address(self) -> Address:
        self._attempt = None  # a resolver cannot be interrupted
        try:
            address = self._turns.address()
        except (OSError, ValueError) as error:
            raise Lost(f"{self._broker} cannot be reached: {error}") from None
        if address != self._address:
            self._bridge_mode, self._limits = BridgeMode(), BrokerLimits()
        return address

    @property
    def _where(self) -> str:
        return f"{self._broker} at {self._address.text}" if self._address and self._turns.several else self._broker

    def _note_failure(self, problem: str, held_s: float) -> None:
        """The turn of the address is over, unless its broker is to be asked once more in another way."""
        turns = self._turns
        if self._is_last_attempt and not self._limits.asks_again:
            failed = turns.failed(problem.removeprefix(f"{self._where} "), held_s)
            if turns.several:
                problem = f"{self._broker}: {failed}"
        if not self._limits.asks_again or held_s > 0:
            self._report_problem(problem, logged=held_s > 0 or turns.is_over or not turns.several)

    def _serve(self, connection: Connection, stopping: threading.Event) -> None:
        tried_at = time.monotonic() + _TRIED_S
        try:
            self._synchronize(connection, stopping)
            if failed := self._turns.succeeded():
                self._log(logging.INFO, f"connected to {connection.where}; before it {failed}")
            while not stopping.is_set():
                connection.pump(_IDLE_S, self._deliver_all if self._retention is None else self._deliver_and_note)
                if connection.limits is not self._reported and time.monotonic() > tried_at:
                    self._report_limits(connection)
                if self._pending and connection.has_room:
                    self._sync_retained(self._own.keys())
                if self._suspects.withheld:
                    self._try_withheld(connection)
                if self._retention is not None:
                    self._check_retention(connection)
        except Silent:
            self._note_loss(connection, None)
            raise
        except Lost:
            # First whether it lacks what all such messages need: else each of their topics would seem to be at fault.
            less, written = (
                self._tries_less(connection, held=time.monotonic() > tried_at),
                connection.written_before_loss(),
            )
            if not (less or self._limits.undecided) or is_large(written):
                self._note_loss(connection, written)
            raise

    def _note_loss(self, connection: Connection, written: Mapping[str, Written] | None) -> None:
        with self._publishing:
            assessment = self._suspects.lost(written, time.monotonic())
        if assessment is not None:
            level = logging.WARNING if assessment.kind is Kind.SUSPECTED else logging.ERROR
            log.log(level, "%s: %s", self.client_id, assessment.text(connection.where))

    def _try_withheld(self, connection: Connection) -> None:
        """See whether the broker accepts the message that is tried, and send the next one that is retained."""
        now = time.monotonic()
        with self._publishing:
            confirmed = self._suspects.confirm(now, connection.has_accepted)
            if confirmed is not None:
                tried, reported = confirmed
                if reported:
                    log.info("%s: %s accepts messages on %s again", self.client_id, connection.where, tried.topic)
                if (newest := self._own.get(tried.topic)) is not None and newest is not tried:
                    self._remember(newest, sent=self._send(newest, False))
            elif now - self._tried_at < _TRY_S:
                return
            self._tried_at = now
            for topic in self._suspects.due(now, self._arrived_at):
                message = self._own.get(topic)
                if message is not None and not self._suspects.accepts(message):
                    self._remember(message, sent=self._send(message, False))
                    return

    def _check_retention(self, connection: Connection) -> None:
        """Ask once for each of our retained messages by name, and report which ones the broker does not have."""
        check, now = self._retention, time.monotonic()
        assert check is not None  # noqa: S101 - the caller looked
        if check.is_due(now):
            if topics := check.begin(self._own_topics_apart(connection)):
                connection.subscribe([(topic, False) for topic in topics], QoS.LATEST)
                self._retention_answer = connection.ping()
            else:
                self._retention = None
        elif check.topics:
            missing = check.missing(now, answered=self._retention_answer.done)
            if missing is not None:
                self._end_retention_check(connection, check, missing)

    def _own_topics_apart(self, connection: Connection) -> list[str]:
        """Topics of our retained messages that the broker should have, and that no subscription of ours receives."""
        with self._routing:
            filters = list(self._filters)
        with self._publishing:
            return [
                topic
                for topic, message in self._own.items()
                if message.payload and topic not in self._shared and self._accepts(connection, message)
                if connection.limits.retain
                if topic not in self.not_taken and not any(overlap(topic, filter_) for filter_ in filters)
            ]

    def _end_retention_check(self, connection: Connection, check: RetentionCheck, missing: list[str]) -> None:
        connection.unsubscribe(check.topics)
        self._retention = None
        if self._address is not None:
            self._checked.add(self._address.text)
        missing = [topic for topic in missing if topic in self._own and topic not in self.not_taken]
        if missing:
            log.warning(
                "%s: %s has not kept what was published on %s: may this account publish there and read it, "
                "and does the broker keep retained messages?",
                self.client_id,
                connection.where,
                named(missing),
            )

    def _make_connection(self, will: Message | None, *, as_published: bool) -> Connection:
        assert self._address is not None  # noqa: S101 - both callers run at an address
        assert self._credentials is not None  # noqa: S101 - and while it is open
        settings = replace(self.settings, password=self._credentials.password())
        return Connection(
            Opening(self._mqtt_client_id, settings, self._credentials.context(), will, self._address),
            self.counters,
            self,
            where=self._where,
            as_published=as_published,
            limits=self._limits.limits,
        )

    def _connect(self, connection: Connection, stopping: threading.Event) -> None:
        try:
            self._broker_stalled |= connection.connect(stopping) > _HESITATION_S
        except Lost as lost:
            self._note_result(lost.result if isinstance(lost, Refused) else Result.FAILED)
            raise
        self._note_result(Result.ACCEPTED)
        if self.settings.as_published:
            as_published = connection.incoming.as_published
            if self.as_published and not as_published:
                log.warning("%s has no bridge mode: own messages come back on this connection", connection.where)
            self.as_published = self.exact_echo = as_published

    @property
    def _asks_for_bridge_mode(self) -> bool:
        """MQTT 5 has options of its own for the same."""
        return self.settings.as_published and self.settings.protocol == "3.1.1"

    def _probe(self, stopping: threading.Event) -> None:
        """Connect without bridge mode, and leave in order; without our will, which a failure would publish."""
        probe = self._attempt = self._make_connection(None, as_published=False)
        try:
            probe.connect(stopping)
            probe.disconnect()
        except Lost:
            self._note_probe(Result.FAILED)
            raise
        finally:
            probe.discard()
        self._note_probe(Result.ACCEPTED)

    @property
    def _is_last_attempt(self) -> bool:
        return not self._asks_for_bridge_mode or self._bridge_mode.next_attempt is Attempt.BRIDGE

    def _note_result(self, result: Result) -> None:
        self._bridge_mode.note(result)
        if self.will is not None or result is Result.ACCEPTED:  # without a will nothing is left to refuse
            self._limits.note_connect(result, time.monotonic(), last=self._is_last_attempt)

    def _note_probe(self, result: Result) -> None:
        if self._bridge_mode.next_attempt is Attempt.PROBE:
            self._bridge_mode.note(result)
        self._limits.note_probe(result)

    def _tries_less(self, connection: Connection, *, held: bool) -> bool:
        """Whether the connection may be lost because of what the broker lacks: the next one uses less."""
        now = time.monotonic()
        if (lacks := connection.incoming.ending.lacks) is not None:
            self._limits.note_connect(lacks, now, last=True)
            return True
        in_flight = Limits(bool(connection.unconfirmed_retained()), int(connection.unacked > 0))
        return self._limits.note_loss(in_flight, connection.confirmed, now, held=held)

    def _report_limits(self, connection: Connection) -> None:
        limits = connection.limits
        if limits.losses and limits != self._reported:
            level = logging.WARNING if self.will is not None or self._own else logging.INFO  # it loses nothing
            log.log(level, "%s: %s %s", self.client_id, connection.where, limits.losses)
        self._reported = limits

    def _synchronize(self, connection: Connection, stopping: threading.Event) -> None:
        """Query which of our retained messages the broker has, subscribe, and send what it lacks."""
        self._renew()
        self._own_message_filter.begin()
        if self._broker_stalled:
            self._let_catch_up(connection, stopping)
        known = self._query_own(connection, stopping)
        with self._routing:
            self._connection = connection
            subscribed = connection.subscribe([(filter_, self._no_local(filter_)) for filter_ in self._filters])
            copied = connection.ping()
        self._await(connection, subscribed, stopping, self._deliver_all)
        self._await(connection, copied, stopping, self._deliver_all)
        now = time.monotonic()
        with self._publishing:
            self._suspects.connected(now)
            connection.pings.doubtful |= self._suspects.doubtful
        self._initial_sync(known)
        self._retention = None
        if self._address is not None and self._address.text not in self._checked:
            self._retention = RetentionCheck(now)

    def _let_catch_up(self, connection: Connection, stopping: threading.Event) -> None:
        """Wait before subscribing: a broker that was suspended first forwards old messages of others."""
        end = time.monotonic() + _CATCH_UP_S
        while not stopping.is_set() and (left := end - time.monotonic()) > 0:
            connection.pump(left, ignore)
        self._broker_stalled = False

    def _query_own(self, connection: Connection, stopping: threading.Event) -> set[str]:
        """Own topics of which the broker has our newest retained message, or that others publish on as well.

        A ping's answer follows these messages (QoS 0).
        """
        self.went_back = False
        with self._publishing:
            own = {topic: message for topic, message in self._own.items() if topic not in self._pending}
            unsure = self._shared | {topic for topic, message in own.items() if not self._accepts(connection, message)}
        topics = list(own)
        if not topics:
            return set()
        connection.subscribe([(topic, False) for topic in topics], QoS.LATEST)
        found: dict[str, bytes] = {}

        def note(messages: list[Message]) -> None:
            found.update((one.topic, one.payload) for one in messages if one.retain and one.topic in own)

        self._await(connection, connection.ping(), stopping, note)
        connection.unsubscribe(topics)
        if self.will is not None and found.get(self.will.topic) == self.will.payload:
            del found[self.will.topic]  # our own will, published although we were running
        older = {topic for topic, payload in found.items() if topic not in unsure and payload != own[topic].payload}
        self.went_back = bool(older)
        return found.keys() - older

    def _accepts(self, connection: Connection, message: Message) -> bool:
        """Whether the broker has, as far as is known, accepted this retained message."""
        return connection.takes(message) and self._suspects.accepts(message)

    def _await(
        self,
        connection: Connection,
        ack: PendingAck,
        stopping: threading.Event,
        receive: Callable[[list[Message]], None],
    ) -> None:
        asked_at = clock.since_boot()
        while not ack.done:
            if stopping.is_set():
                raise Lost("closed")
            left = max(asked_at, connection.incoming.age.arriving_at) + _ANSWER_S - clock.since_boot()
            if left < 0:
                raise Silent(f"{connection.where} does not answer")
            connection.pump(left, receive)

    def _deliver_and_note(self, messages: list[Message]) -> None:
        if self._retention is not None:
            self._retention.note(messages, time.monotonic())
        self._deliver_all(messages)

    def _deliver_all(self, messages: list[Message]) -> None:
        if self._suspects.withheld:
            self._arrived_at = time.monotonic()
        for message in messages:
            self.count_received()
            repeat = False
            if message.retain and self.as_published:
                if self._own_message_filter.is_echo(message):
                    self.counters.add("echoes")
                    continue
                repeat = self._own_message_filter.is_repeat(message)
            for subscription in self._matched.get(message.topic) or self._matching(message.topic):
                subscription.offer(message, repeat=repeat)

    def note_answers(self, refused: Mapping[str, bool]) -> None:
        if self._connection is None:
            return  # to the query of our own retained messages
        if self._retention is not None:
            for filter_ in [filter_ for filter_, is_refused in refused.items() if is_refused]:
                self._retention.refused(filter_)
        with self._lock:
            for filter_, is_refused in refused.items():
                for subscription in self._subscriptions:
                    if overlap(subscription.filter, filter_):  # the filter that covers it: no other one overlaps
                        subscription.refused = is_refused

    def note_refusal(self, topic: str, why: str) -> None:
        self._report_not_taken(self._where, topic, why)

    def _finish(self, connection: Connection) -> None:
        """Publish the will, wait (bounded) until everything is acknowledged, then send DISCONNECT."""
        if self._will_on_close is not None:
            connection.publish(self._will_on_close)
        last = connection.ping()
        deadline = time.monotonic() + _CLOSING_S
        while time.monotonic() < deadline and not (last.done and connection.drained):
            connection.pump(deadline - time.monotonic(), ignore)
        connection.disconnect()

    def _keep_unconfirmed(self, connection: Connection) -> None:
        """Mark retained messages that the broker may not have received as pending."""
        self.counters.add("unconfirmed", connection.unacked)
        with self._publishing:
            for message in connection.unconfirmed_retained():
                if message.topic not in self._pending:
                    self._remember(message, sent=False)

    def _report_not_taken(self, where: str, topic: str, why: str, level: int = logging.WARNING) -> None:
        """Once for each topic, and again after a while: any number of messages may follow."""
        now = time.monotonic()
        if now - self.not_taken.get(topic, ("", -inf))[1] >= _NOT_TAKEN_S:
            self.not_taken[topic] = why, now
            log.log(level, "%s: %s does not take a message on %s: %s", self.client_id, where, topic, why)

    def _report_problem(self, problem: str, *, logged: bool) -> None:
        self.problem = problem
        if logged:
            self._log(logging.WARNING, problem)

    def _log(self, level: int, line: str) -> None:
        now = time.monotonic()
        if line != self._logged[0] or now - self._logged[1] > _REPEAT_LOG_S:
            self._logged = (line, now)
            log.log(level, "%s: %s", self.client_id, line)


TRANSPORT = MqttTransport
