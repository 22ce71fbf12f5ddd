"""The Zenoh transport: processes exchange messages directly, and a hub stores retained messages and wills.

Every process is a peer connected to every sibling process, so that live messages do not need the hub
(docs/transports.md).
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from typing import TypeVar

import zenoh

from pebble.errors import TransportError
from pebble.transports import clock
from pebble.transports.base import QUEUE_BYTES, QUEUE_LIMIT, Message, QoS, State, Subscription, Transport
from pebble.transports.bounds import BoundedQueue
from pebble.transports.counters import Counters
from pebble.transports.peers import PeerRegistry, PresenceLock, new_name, prepare_run_dir
from pebble.transports.settings import ZenohSettings
from pebble.transports.topics import is_pattern
from pebble.transports.zenoh import wire
from pebble.transports.zenoh.ages import MessageAges
from pebble.transports.zenoh.callbacks import direct
from pebble.transports.zenoh.keymap import filter_to_key, key_to_topic, topic_to_key
from pebble.transports.zenoh.presence import Barrier, HubView, HubWatch
from pebble.transports.zenoh.session import (
    HUB_SOCKET,
    check_process,
    close_at_exit,
    close_session,
    open_session,
    session_config,
)

log = logging.getLogger(__name__)

OPEN_SYNC_S = 1.0  # the longest wait for siblings that do not answer, when opening,
SYNC_S = 0.5  # when subscribing or reconnecting to the hub,
FETCH_S = 0.7  # the same for the hub's retained messages, which it may delay for half a second
GOODBYE_S = 0.3  # and when closing
HUB_ANSWER_S = 1.0
RETAINED_ANSWER_S = 3.0
_RETRY_S = 0.2
_LOOK_S = 1.0  # between two looks at the files of this process in the run directory
_PUBLISHERS = 1000  # topics for which one is declared
_TOPIC_LIMIT = 10_000  # topics whose priority, or removal, is remembered

_V = TypeVar("_V")


class ZenohTransport(Transport):
    """One client of a robot's Zenoh network. In CONNECTING the hub is away; running peers still receive each other."""

    def __init__(self, client_id: str, settings: ZenohSettings, *, will: Message | None = None) -> None:
        super().__init__(client_id, will=will)
        self._settings = settings
        self._registry = PeerRegistry(settings.run_dir)
        self._connecting = threading.RLock()  # held while subscribing, and while a connection is made
        self._subscribers: dict[Subscription, zenoh.Subscriber[None]] = {}
        # By topic: with two priorities, messages of a topic would overtake each other (T3).
        self._urgent: dict[str, bool] = {}
        # Retained topics we have removed, in case a hub that was ending did not receive the removal.
        self._removed: dict[str, None] = {}
        self._retained_count = 0  # of retained messages published so far
        self._syncing = False
        self._putting = 0  # the thread that is inside put() with a live message
        self._connection = 0
        self._connection_lock = threading.Lock()  # no answer of a connection is offered after the next one began
        self._reset()

    def _reset(self) -> None:
        self._name = ""
        self._pid = os.getpid()
        self._late_s = self._settings.lease_ms / 1000
        self._message_ages = MessageAges(wire.BOOT, self._late_s)
        self._presence: PresenceLock | None = None
        self._session: zenoh.Session | None = None
        self._publishers: dict[tuple[str, QoS], zenoh.Publisher] = {}
        self._barrier: Barrier | None = None
        self._token: zenoh.LivelinessToken | None = None
        self._watch = HubWatch()
        self._loopback = LoopbackQueue(self.counters)
        self._opened = threading.Event()
        self._client_config = ""
        self._lost = ""  # why this process cannot listen where others look for it
        self._thread: threading.Thread | None = None

    # -- opening and closing

    def _open(self, timeout: float) -> None:
        self._reset()
        prepare_run_dir(self._settings.run_dir)
        self.problem = f"no hub answers in {self._settings.run_dir}"
        if self._settings.client:
            hub = [] if self._settings.connect else [self._settings.run_dir / HUB_SOCKET]
            self._client_config = session_config(self._settings, "client", listen=[], connect=hub)
        else:
            self._start_peer()
        self._thread = threading.Thread(target=self._run, name=f"pebble-zenoh {self.client_id}", daemon=True)
        self._thread.start()
        close_at_exit(self)
        self._opened.wait(min(timeout, OPEN_SYNC_S))

    def _start_peer(self) -> None:
        self._presence = self._registry.register(self.client_id)
        try:
            self._listen(self._presence)
        except TransportError:
            self._presence.release()
            raise

    def _listen(self, presence: PresenceLock) -> None:
        try:
            hub = self._settings.run_dir / HUB_SOCKET
            siblings = self._registry.sockets(but=presence.name)
            config = session_config(self._settings, "peer", listen=[presence.socket], connect=[hub, *siblings])
            session = open_session(config)
        except (zenoh.ZError, TransportError) as error:
            raise TransportError(f"zenoh session of {self.client_id}: {error}") from None
        if self._begin(session, presence.name):
            presence.ready()

    def _start_client(self) -> bool:
        """Try until a hub answers: a session in client mode cannot open without one."""
        while not self._watch.closed:
            try:
                session = open_session(self._client_config)
            except zenoh.ZError as error:
                log.debug("%s: %s", self.client_id, error)
                self.problem = f"no hub answers at {_hub_addresses(self._settings)}"
                self._watch.wait_closed(_RETRY_S)
                continue
            if self._begin(session, new_name()):
                return True
        return False

    def _begin(self, session: zenoh.Session, name: str) -> bool:
        with self._connection_lock:
            if self._watch.closed:
                close_session(session)
                return False
            self._name, self._session, self._publishers = name, session, {}
        self._barrier = Barrier(session, name, lambda: self._retained_count)
        self._token = session.liveliness().declare_token(wire.LIVE + name)
        with self._connecting:
            for subscription in list(self._subscriptions):
                self._start(session, subscription)
        self._watch.follow(session)
        return True

    def _close(self, will: Message | None) -> None:
        self._watch.close()
        with self._connection_lock:
            session = self._session
        if session is not None and self._pid == os.getpid():
            self._publish_will_and_leave(session, will)
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(OPEN_SYNC_S + HUB_ANSWER_S)
        self._loopback.close()
        if self._presence is not None:
            self._presence.release()
        self._subscribers.clear()
        self._publishers.clear()
        self._session = None

    def _publish_will_and_leave(self, session: zenoh.Session, will: Message | None) -> None:
        try:
            if will is not None:
                self._send(will, False)
                self._ask_hub(session, wire.BYE, wire.encode(self._name), GOODBYE_S)
            self._synchronize(GOODBYE_S)  # when they answer, they have received our last messages
        except zenoh.ZError as error:
            log.warning("%s could not close in order: %s", self.client_id, error)
        finally:
            close_session(session)

    # -- the transport's thread: every time a hub appears a new connection begins

    def _run(self) -> None:
        if self._settings.client and not self._start_client():
            return
        seen = linked = 0
        look_s = None if self._presence is None else _LOOK_S
        self._initial_synchronization()
        while (view := self._watch.wait(seen, _RETRY_S if self._watch.hubs and not linked else look_s)) is not None:
            try:
                if self._presence is not None and not (self._session and self._presence.in_place):
                    linked = 0 if self._listen_again(self._presence) else linked
                    continue
                linked = self._follow(view, seen, linked)
            except Exception:  # any error must lead to a reconnect, never end the thread
                if self._watch.closed:
                    return
                log.exception("%s: unexpected failure of the connection to the hub", self.client_id)
                linked = 0
                self._watch.wait_closed(HUB_ANSWER_S)
            seen = view.version

    def _listen_again(self, presence: PresenceLock) -> bool:
        """Open a new session where processes that start now find this one; False if that cannot be: then keep the old.

        Its files, or the whole run directory, were removed: by a cleaner of old files, or when a user logged out.
        """
        try:
            prepare_run_dir(self._settings.run_dir)
            presence.renew()
        except (OSError, TransportError) as error:
            self._report_lost(f"{error}. Until then processes that start again do not reach this one")
            self._watch.wait_closed(_LOOK_S)
            return False
        self._end_session()
        try:
            self._listen(presence)
        except TransportError as error:  # it was removed again
            self._report_lost(str(error))
            self._watch.wait_closed(_LOOK_S)
            return True
        self._lost = ""
        log.warning("%s: its socket was removed from %s, it has made a new one", self.client_id, self._settings.run_dir)
        self._initial_synchronization()
        return True

    def _end_session(self) -> None:
        """Close the session without its will: another one of this process follows."""
        self._set_state(State.CONNECTING)
        with self._publishing, self._connection_lock:
            session, self._session, self._publishers = self._session, None, {}
        if session is None:
            return
        with contextlib.suppress(zenoh.ZError):
            self._ask_hub(session, wire.BYE, wire.encode(self._name), GOODBYE_S)
        with self._connecting:
            close_session(session)
            self._subscribers.clear()
        self._watch.reset()

    def _report_lost(self, problem: str) -> None:
        if problem != self._lost:
            self._lost = problem
            log.error("%s: its socket was removed, and it cannot make a new one: %s", self.client_id, problem)

    def _initial_synchronization(self) -> None:
        try:
            self._synchronize(OPEN_SYNC_S)
        except zenoh.ZError as error:  # closed meanwhile
            log.debug("%s could not synchronize with its siblings: %s", self.client_id, error)
        self._opened.set()

    def _follow(self, view: HubView, seen: int, linked: int) -> int:
        """Process a change; return the number of the working connection to a hub, 0 for none."""
        if not view.hubs:
            self.problem = f"the hub of {self._settings.run_dir} is away"
            self._set_state(State.CONNECTING)
            return 0
        if view.connection != linked:
            return view.connection if self._connect_hub() else 0
        if view.version != seen:
            self._refresh()
        return linked

    def _connect_hub(self) -> bool:
        """Send the hub our will and what it lacks, and query its retained messages."""
        session = self._session
        self._set_state(State.CONNECTING)
        if session is None or not self._send_hello(session):
            self.problem = f"the hub of {self._settings.run_dir} does not answer"
            return False
        self._refresh()
        self._set_state(State.CONNECTED)
        self._send_lacking(session, set())  # what became pending meanwhile
        return True

    def _send_hello(self, session: zenoh.Session) -> bool:
        """Store the will at the hub and send what the hub lacks, until it lacks nothing that it has room for."""
        end = time.monotonic() + HUB_ANSWER_S
        sent: set[str] = set()
        while time.monotonic() < end:
            with self._publishing:
                hello = wire.Hello(self._name, self._retained_count, self._wire_will(), self._digests())
            answers = self._ask_hub(session, wire.HELLO, wire.encode(hello), end - time.monotonic())
            if not answers:
                return False
            lacking = {key_to_topic(key) for answer in answers for key in wire.decode_keys(answer)}
            if not self._send_lacking(session, lacking - sent):  # it had no room for what it lacks again
                return True
            sent |= lacking
        return False

    def _wire_will(self) -> wire.Will | None:
        return None if self.will is None else wire.Will.of(self.will, self.client_id)

    def _digests(self) -> dict[str, int | None]:
        gone: dict[str, int | None] = {topic_to_key(topic): None for topic in self._removed}
        return gone | {topic_to_key(topic): wire.digest(own.payload) for topic, own in self._own.items() if own.payload}

    def _send_lacking(self, session: zenoh.Session, lacking: set[str]) -> bool:
        """Send the hub, and only the hub, what is pending and what it lacks; False if that is nothing.

        Running peers have received these messages live.
        """
        with self._publishing:
            owed = bool(self._pending or lacking)
            self._syncing = True
            try:
                self._sync_retained(self._own.keys() - lacking)
                for topic in lacking & self._removed.keys():
                    self._put_retained(session, Message(topic, b"", QoS.DELIVERED, retain=True))
            finally:
                self._syncing = False
            return owed

    def _refresh(self) -> None:
        """Query all retained messages, as on a new connection: connections have been down."""
        with self._connecting:
            if self._session is None:
                return
            with self._connection_lock:
                self._connection += 1
                self._renew()
            numbers = self._synchronize(SYNC_S)  # after _renew: messages received live meanwhile are newer
            self._fetch(self._session, list(self._subscribers), numbers)

    # -- sending

    def _send(self, message: Message, urgent: bool) -> bool:
        if self._pid != os.getpid():
            check_process(self._pid)
        session = self._session
        if session is None or (self._settings.client and not self._watch.hubs):
            return False
        try:
            if message.retain:
                self._count(message)
                self._put_retained(session, message)
            if not self._syncing:
                self._put_live(session, message, urgent)
        except zenoh.ZError as error:
            log.debug("%s could not send: %s", self.client_id, error)
            return False
        return True

    def _put_live(self, session: zenoh.Session, message: Message, urgent: bool) -> None:
        publisher = self._publishers.get((message.topic, message.qos)) or self._declare_publisher(
            session, message, urgent
        )
        stamp = wire.pack_live(message.qos, retain_requested=message.retain)
        self._putting = threading.get_ident()
        try:
            if publisher is not None:
                publisher.put(message.payload, attachment=stamp)
            else:
                treatment = wire.TREATMENTS[message.qos, self._urgent.get(message.topic, urgent)]
                session.put(topic_to_key(message.topic), message.payload, attachment=stamp, **treatment)
        finally:
            self._putting = 0

    def _declare_publisher(self, session: zenoh.Session, message: Message, urgent: bool) -> zenoh.Publisher | None:
        """Declare a publisher, which sends to subscribers only; without it the hub gets a copy of every message.

        Measured with 1.10.2 on two cores at 200 Hz: saves 3 to 5 % of a core in the hub, and a message takes 0.85 of
        the time between two processes. But each key for which one was ever declared costs 2.4 KB here and in the hub
        until the session ends (20,000 keys, declared and undeclared again: 23 to 72 MB): so no topic that strangers
        have invented gets one, and only the first of the others.
        """
        urgent = _remember_first(self._urgent, message.topic, urgent)
        if len(self._publishers) >= _PUBLISHERS or self.is_invented(message.topic):
            return None
        treatment = wire.TREATMENTS[message.qos, urgent]
        publisher = session.declare_publisher(topic_to_key(message.topic), **treatment)
        self._publishers[message.topic, message.qos] = publisher
        return publisher

    def _count(self, message: Message) -> None:
        if not self._syncing:
            self._retained_count += 1
        if message.payload:
            self._removed.pop(message.topic, None)
        else:
            _remember_first(self._removed, message.topic, None)

    def _put_retained(self, session: zenoh.Session, message: Message) -> None:
        """Send to the hub, before the live message: a subscription made in between gets at least one of the two."""
        stamp = wire.Stamp(message.qos, 0 if self._syncing else self._retained_count, self._name)
        session.put(wire.RETAINED + topic_to_key(message.topic), message.payload, attachment=stamp.pack(), **wire.BLOCK)

    # -- receiving

    def _declare(self, subscription: Subscription) -> None:
        check_process(self._pid)
        with self._connecting:
            session = self._session
            if session is None:
                return  # it is declared when there is a session
            with contextlib.suppress(zenoh.ZError):  # closed meanwhile: then nothing is received any more
                self._start(session, subscription)
                numbers = self._synchronize(SYNC_S)
                if self._state is State.CONNECTED:
                    self._fetch(session, [subscription], numbers)

    def _undeclare(self, subscription: Subscription) -> None:
        subscriber = self._subscribers.pop(subscription, None)
        if subscriber is not None:
            with contextlib.suppress(zenoh.ZError):  # closed meanwhile
                subscriber.undeclare()  # type: ignore[no-untyped-call]

    def _start(self, session: zenoh.Session, subscription: Subscription) -> None:
        if subscription in self._subscribers:
            return
        origin = zenoh.Locality.ANY if subscription.echo else zenoh.Locality.REMOTE
        only = None if is_pattern(subscription.filter) else subscription.filter
        may_be_ours = subscription.direct and subscription.echo

        def take(sample: zenoh.Sample) -> None:
            self.count_received()
            read_at = clock.since_boot()
            stamp = wire.read_live(sample.attachment)
            # A sender of the same boot shares the clock, so that also the time in the socket counts.
            since = stamp.sent_ns / 1e9 if stamp.boot == wire.BOOT else None
            if (since is None or read_at - since > self._late_s) and self._is_late(sample, stamp, read_at):
                return
            topic, payload = only or key_to_topic(str(sample.key_expr)), sample.payload.to_bytes()
            qos = min(stamp.qos, subscription.qos)
            message = Message(topic, payload, qos, False, stamp.retain_requested, read_at if since is None else since)
            if may_be_ours and self._putting == threading.get_ident():
                self._loopback.put(subscription, message)
            else:
                subscription.offer(message)

        self._subscribers[subscription] = session.declare_subscriber(
            filter_to_key(subscription.filter), direct(take), allowed_origin=origin
        )

    def _is_late(self, sample: zenoh.Sample, stamp: wire.LiveStamp, now: float) -> bool:
        """Whether it waited in a socket while this process was stopped, longer than the lease of a connection (T19).

        Retained messages are accepted in any case, because they are not sent again.
        """
        if not stamp.boot:
            return False
        age_s = self._message_ages.age_s(stamp.boot, stamp.sent_ns / 1e9, now)
        if stamp.retain_requested or age_s <= self._late_s:
            return False
        self.counters.add("late")
        log.debug("%s: a message of %s was %.1f s late and is dropped", self.client_id, sample.key_expr, age_s)
        return True

    def _fetch(self, session: zenoh.Session, subscriptions: list[Subscription], numbers: dict[str, int]) -> None:
        """Query retained messages and wait for them, so that none comes among messages published after we returned."""
        end = time.monotonic() + FETCH_S
        answered = [self._query_retained(session, subscription, numbers) for subscription in subscriptions]
        for event in answered:
            event.wait(max(0.0, end - time.monotonic()))

    def _query_retained(
        self, session: zenoh.Session, subscription: Subscription, numbers: dict[str, int]
    ) -> threading.Event:
        """``numbers``: how many retained messages each sibling has sent; the hub answers once it has received those."""
        connection, answered = self._connection, threading.Event()

        def take(reply: zenoh.Reply) -> None:
            sample = reply.ok
            if sample is None or sample.attachment is None:
                return
            stamp = wire.Stamp.unpack(sample.attachment.to_bytes())
            if stamp.origin == self._name and not subscription.echo:
                return
            self.count_received()
            message = _retained_message(sample, stamp, subscription.qos)
            with self._connection_lock:
                if connection == self._connection:
                    subscription.offer(message)

        session.get(
            wire.RETAINED + filter_to_key(subscription.filter),
            direct(take, answered.set),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=RETAINED_ANSWER_S,
            payload=wire.encode({name: number for name, number in numbers.items() if number}),
            **wire.BLOCK,
        )
        return answered

    # -- queries

    def _synchronize(self, timeout: float) -> dict[str, int]:
        return {} if self._barrier is None else self._barrier.synchronize(self._expected, timeout)

    def _expected(self) -> dict[str, str]:
        """The peers that must answer before our declarations are surely known: all running in this run directory."""
        remote = self._settings.client and self._settings.connect
        siblings = {} if remote else self._registry.ready(but=self._name)
        return siblings | dict.fromkeys(self._watch.hubs, "the hub")

    def _ask_hub(self, session: zenoh.Session, what: str, payload: bytes, timeout: float) -> list[bytes]:
        """Query the hub; return its answers, none if no hub answers in time."""
        replies = session.get(
            what,
            zenoh.handlers.FifoChannel(16),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout,
            payload=payload,
            **wire.BLOCK,
        )
        return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]


class LoopbackQueue:
    """Hands a transport's own messages to its own direct handlers, on a thread that starts with the first message.

    Zenoh delivers to subscribers of the same session inside ``put()``. A direct handler called there would run under
    the publisher's lock, and two that publish to each other would deadlock.
    """

    def __init__(self, counters: Counters) -> None:
        self._counters = counters
        self._arrived = threading.Condition()
        self._queue = BoundedQueue[tuple[Subscription, Message]](QUEUE_LIMIT, QUEUE_BYTES)
        self._thread: threading.Thread | None = None
        self._closed = False

    def put(self, subscription: Subscription, message: Message) -> None:
        with self._arrived:
            if self._closed:
                return
            for _lost in self._queue.append((subscription, message), len(message.topic) + len(message.payload)):
                self._counters.add("dropped")
            self._arrived.notify()
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="pebble-echo", daemon=True)
                self._thread.start()

    def close(self) -> None:
        with self._arrived:
            self._closed = True
            self._queue.clear()
            self._arrived.notify()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(1.0)

    def _run(self) -> None:
        while True:
            with self._arrived:
                self._arrived.wait_for(lambda: self._queue or self._closed)
                if self._closed:
                    return
                subscription, message = self._queue.popleft()
            subscription.offer(message)


def _retained_message(sample: zenoh.Sample, stamp: wire.Stamp, qos: QoS) -> Message:
    topic = key_to_topic(str(sample.key_expr).removeprefix(wire.RETAINED))
    return Message(topic, sample.payload.to_bytes(), min(stamp.qos, qos), retain=True, retain_requested=True)


def _remember_first(by_topic: dict[str, _V], topic: str, value: _V) -> _V:
    """The first value ever given for ``topic``; the oldest topic is forgotten when there are too many."""
    if topic not in by_topic and len(by_topic) >= _TOPIC_LIMIT:
        by_topic.pop(next(iter(by_topic)))
    return by_topic.setdefault(topic, value)


def _hub_addresses(settings: ZenohSettings) -> str:
    """The addresses of a client's hub, for error texts."""
    return ", ".join(settings.connect) or str(settings.run_dir / HUB_SOCKET)


TRANSPORT = ZenohTransport
