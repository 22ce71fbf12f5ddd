"""The publish/subscribe interface, with all behaviour that does not depend on the backend.

docs/transports.md numbers the promises (T1 to T21) that every backend keeps; the tests have the same numbers.
"""

from __future__ import annotations

import logging
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from enum import Enum
from types import TracebackType
from typing import Any, Self

from msgspec import Struct

from pebble.errors import TransportError
from pebble.transports.bounds import BoundedQueue, BoundedTable
from pebble.transports.counters import Counters
from pebble.transports.message import Message as Message
from pebble.transports.message import QoS as QoS
from pebble.transports.own_retained import OwnRetained
from pebble.transports.topics import REMEMBERED_LENGTH, check_filter, check_topic, matches

log = logging.getLogger(__name__)

QUEUE_LIMIT = 1000  # messages waiting for a slow handler before the oldest is dropped
QUEUE_BYTES = 16 << 20  # the same, for their topics and payloads
_MATCHED = 512  # topics whose subscriptions are remembered
_DELIVERED_TOPICS_LIMIT = 65_536  # topics a subscription remembers as delivered, per connection; see `offer`
_DELIVERED_TOPICS_BYTES = 4 << 20  # of these topics; a value is None, and counts 0
_HANDLER_END_S = 1.0  # how long closing waits for handlers that are running
_TRIED_S = 0.02  # how soon `open` notices that all addresses were tried
_NAMED = 3  # subscriptions in one line
_WARNING_PERIOD_S = 5.0  # between two log lines about the same overflowing subscription


class State(Enum):
    CLOSED = "closed"
    CONNECTING = "connecting"
    CONNECTED = "connected"


Watcher = Callable[[State], None]


class Outgoing(Struct, frozen=True):
    """The messages that a transport has accepted and not delivered yet; not the contract's direction ``outgoing``.

    All figures are zero from a backend that cannot measure them (T20).
    """

    waiting: int = 0  # bytes that the other machine has not confirmed, including some overhead of the protocols
    round_trip_s: float = 0.0  # the shortest of this connection: bytes that wait for less are merely travelling
    stalled_s: float = 0.0  # how long messages of QoS 1 wait and none was acknowledged, beyond two usual round trips


class Answer(Struct, frozen=True):
    """The newest answer of the other end to a ping, or the oldest ping that is still unanswered."""

    number: int  # of answers on this connection
    seconds: float  # that it took, or has taken so far
    queue_s: float | None  # by so much TCP's own round trips are longer than the shortest; None: the system cannot tell
    delivered_s: float = 0.0  # so long ago the newest ping was sent before whose answer everything is delivered
    late_s: float = 0.0  # by so much longer than usual it took, or the next answer takes


Handler = Callable[[Message], None]


class Subscription:
    """A filter with its handler and the bounded queue between them. :meth:`Transport.subscribe` makes it."""

    def __init__(
        self, transport: Transport, filter_: str, handler: Handler, *, qos: QoS, echo: bool, direct: bool, limit: int
    ) -> None:
        self.filter, self.qos, self.echo = filter_, qos, echo
        self.dropped = 0  # messages lost because the handler was too slow
        self.refused = False  # by the other end, on the newest connection; its transport sets it (T21)
        self._transport, self._handler = transport, handler
        self._count_delivered = transport.counters.adder("delivered")
        self._lock = threading.RLock()
        self._arrived = threading.Condition(self._lock)
        self._queue = BoundedQueue[Message](limit, QUEUE_BYTES)
        self._delivered_topics = BoundedTable[None](_DELIVERED_TOPICS_LIMIT, _DELIVERED_TOPICS_BYTES, lambda _: 0)
        self._closed = False
        self._warned_at = float("-inf")
        self._thread: threading.Thread | None = None
        if not direct:
            self._thread = threading.Thread(target=self._run, name=f"pebble-sub {filter_}", daemon=True)
            self._thread.start()

    @property
    def direct(self) -> bool:
        """True if the handler runs on the receiving thread."""
        return self._thread is None

    def close(self) -> None:
        """Stop delivery: no handler call starts after this has returned. Safe from inside the handler."""
        self._stop()
        self._transport._forget(self)
        self._join(_HANDLER_END_S)  # a quick handler that runs now ends before this returns

    # -- for transports

    def offer(self, message: Message, *, repeat: bool = False) -> None:
        """Queue ``message``, unless it is a retained message of a topic this connection has already delivered (T5, T8).

        With ``policy.delivers_late`` such a message is queued, too. If ``transport.as_published`` is True, retained and
        live messages look alike: then the backend sets ``repeat`` when it is sure that the message is a repetition.
        """
        transport = self._transport
        with self._lock:
            if self._closed:
                return
            if not transport.as_published:  # then the flag marks old messages
                repeat = message.retain and not transport.policy.delivers_late
            if not self._delivered_topics.has(message.topic):
                self._delivered_topics[message.topic] = None
            elif repeat:
                transport.counters.add("stale")
                return
            if self._thread is None:
                self._call(message)
                return
            for lost in self._queue.append(message, len(message.topic) + len(message.payload)):
                self._overflow(lost)
            self._arrived.notify()

    def renew(self) -> None:
        """Note that a new connection has begun, on which retained messages are delivered again."""
        with self._lock:
            self._delivered_topics.clear()

    def _overflow(self, lost: Message) -> None:
        self.dropped += 1
        self._transport.counters.add("dropped")
        now = time.monotonic()
        if lost.qos is QoS.DELIVERED and now - self._warned_at >= _WARNING_PERIOD_S:
            self._warned_at = now
            log.warning("handler of %s is too slow: %d messages dropped, oldest first", self.filter, self.dropped)

    def _run(self) -> None:
        while True:
            with self._lock:
                while not self._queue and not self._closed:
                    self._arrived.wait()
                if self._closed:
                    return
                message = self._queue.popleft()
            self._call(message)

    def _call(self, message: Message) -> None:
        self._count_delivered()
        try:
            self._handler(message)
        except Exception:  # a handler must not take the receiving thread down (T13)
            self._transport.counters.add("handler_errors")
            log.exception("handler of %s failed on a message of %s", self.filter, message.topic)

    def _stop(self) -> None:
        with self._lock:
            self._closed = True
            self._queue.clear()
            self._arrived.notify_all()

    def _join(self, timeout: float) -> None:
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(timeout)


class Subscriptions:
    """The subscriptions of one transport, searched by topic; thread-safe."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.matched: dict[str, tuple[Subscription, ...]] = {}  # by topic; empty after each change
        self._all: list[Subscription] = []

    def __iter__(self) -> Iterator[Subscription]:
        """Iterate over the present subscriptions."""
        with self.lock:
            return iter(list(self._all))

    def add(self, subscription: Subscription) -> None:
        with self.lock:
            self._all.append(subscription)
            self.matched.clear()

    def remove(self, subscription: Subscription) -> bool:
        """Remove a subscription; return True if it was there."""
        with self.lock:
            if subscription not in self._all:
                return False
            self._all.remove(subscription)
            self.matched.clear()
            return True

    def remove_all(self) -> list[Subscription]:
        with self.lock:
            removed, self._all = self._all, []
            self.matched.clear()
            return removed

    def matching(self, topic: str) -> tuple[Subscription, ...]:
        """Return the subscriptions that match ``topic``.

        The result is remembered by topic, because matching takes longer than all other steps of a message here.
        """
        with self.lock:
            matching = self.matched.get(topic)
            if matching is None:
                matching = tuple(subscription for subscription in self._all if matches(subscription.filter, topic))
                if len(self.matched) >= _MATCHED:
                    self.matched.clear()
                if len(topic) <= REMEMBERED_LENGTH:
                    self.matched[topic] = matching
            return matching


class TopicPolicy(Struct):
    """Rules about topics and retained messages, which the owner of a transport sets before it opens it."""

    #: True for topics of stops: where a backend refuses messages because too many wait, it still takes these.
    is_stop: Callable[[str], bool] = lambda _topic: False
    #: True for topics whose names clients make up, any number of them: a backend stores nothing for such a topic.
    is_invented: Callable[[str], bool] = lambda _topic: False
    #: True for topics (UTF-8) whose retained messages are discarded before anything else is done with them: a client
    #: may leave 100,000. Called with locks held: it must neither wait nor publish. A backend may ignore it.
    skips_retained: Callable[[bytes], bool] = lambda _topic: False
    #: Deliver a retained message also after a live one of its topic (T8): the live one may have been our own. The owner
    #: then decides which of them counts.
    delivers_late: bool = False
    #: Returns the messages that are published in place of one, in this order; :meth:`Transport.publish` returns the
    #: outcome of the first. None: the message itself.
    forms: Callable[[Message], Iterable[Message]] | None = None


class Transport(ABC):
    """A client of a publish/subscribe network: the shared behaviour; a backend supplies the abstract methods.

    All methods may be called from any thread, and from inside handlers.
    """

    #: True if ``subscribe(echo=False)`` is exact (T16). A backend that cannot provide it sets False once it knows.
    exact_echo: bool = True
    #: True if ``retain`` of received messages means "retained, or published with retain"; own messages never come back
    #: then (T7).
    as_published: bool = False
    #: True if the other end had older values of what only we publish when the newest connection began: it was restored
    #: from an earlier save, or is another one. A backend that cannot notice it leaves it False.
    went_back: bool = False
    #: True if the newest connection ended because the other end went down, and it was down at every try since: no
    #: client can have published there without our receiving it.
    was_ended: bool = True
    #: True if the link to the other end is thin: keep little in the kernel, where nothing can overtake it, ask less
    #: often and wait longer for answers. Set by :meth:`suit_link`; a backend may ignore it.
    is_thin: bool = False
    settings: Any = None  # of the backend

    def __init__(self, client_id: str, *, will: Message | None = None) -> None:
        if will is not None:
            check_topic(will.topic)
        self.client_id, self.will = client_id, will
        self.policy = TopicPolicy()
        self.counters = Counters()
        self._count_sent = self.counters.adder("sent")
        self.count_received = self.counters.adder("received")
        #: One line that explains why there is no connection; empty while there is one.
        self.problem = ""
        self._state = State.CLOSED
        self._changing = threading.RLock()  # held while the state changes and its watchers are called
        self._connected = threading.Event()
        self._watchers: list[Watcher] = []
        self._subscriptions = Subscriptions()
        self._publishing = threading.RLock()  # one publish at a time: the order of calls is the order per topic (T3)
        self._own = OwnRetained(self.counters)

    # -- what services call

    @property
    def state(self) -> State:
        return self._state

    @property
    def outgoing(self) -> Outgoing:
        """The messages that were accepted and are not delivered yet, where the backend can measure them (T20)."""
        return Outgoing()

    @property
    def answer(self) -> Answer | None:
        """The newest answer to a ping; None while there is none, and from a backend that sends no pings."""
        return None

    @property
    def untried(self) -> bool:
        """True if the broker's name has addresses that were not tried yet."""
        return False

    @property
    def not_received(self) -> str:
        """Return one line about the subscriptions that the other end refuses; empty if it refuses none."""
        refused = [subscription.filter for subscription in self._subscriptions if subscription.refused]
        more = f" and {len(refused) - _NAMED} more" if len(refused) > _NAMED else ""
        return f"it refuses to deliver {', '.join(refused[:_NAMED])}{more}" if refused else ""

    def suit_link(self, *, thin: bool) -> None:
        """Set whether the link to the other end is thin (`is_thin`)."""
        self.is_thin = thin

    def renew_connection(self, why: str) -> None:  # noqa: B027 - where no other end keeps messages, nothing is to be done
        """Close the connection and open a new one. What the broker has queued for the old one is dropped.

        ``why`` is for the log.
        """

    def on_state(self, watcher: Watcher) -> None:
        """Call ``watcher`` on every change of state, in order, on a thread of the transport. It must not wait."""
        self._watchers.append(watcher)

    def open(self, timeout: float = 5.0) -> Self:
        """Start connecting, and wait up to ``timeout`` seconds for success.

        If a name has several addresses it waits, unless ``timeout`` is 0, until each was tried. It returns in any case:
        a robot works without its broker. ``state`` and ``problem`` hold the result. Raises TransportError only for
        settings that can never work.
        """
        if self._state is not State.CLOSED:
            raise TransportError(f"transport {self.client_id} is already open")
        self._set_state(State.CONNECTING)
        try:
            self._open(timeout)
        except TransportError:
            self._set_state(State.CLOSED)
            raise
        connected = self._connected.wait(timeout)
        while timeout and not connected and self.untried and self.state is State.CONNECTING:
            connected = self._connected.wait(_TRIED_S)
        return self

    def close(self) -> None:
        """Disconnect and free all resources. The will is published, so that others receive it as after a crash."""
        with self._changing:
            if self._state is State.CLOSED:
                return
            connected = self._state is State.CONNECTED
            self._set_state(State.CLOSED)
        subscriptions = self._subscriptions.remove_all()
        for subscription in subscriptions:
            subscription._stop()
        self._close(self.will if connected else None)
        deadline = time.monotonic() + _HANDLER_END_S
        for subscription in subscriptions:
            subscription._join(max(0.0, deadline - time.monotonic()))

    def publish(
        self,
        topic: str,
        payload: bytes,
        *,
        qos: QoS = QoS.LATEST,
        retain: bool = False,
        urgent: bool = False,
        remember: bool = True,
        shared: bool = False,
    ) -> bool:
        """Publish one message; return whether it was accepted.

        A live message is refused while there is no connection, and never delivered late. In CONNECTING a peer of Zenoh
        is still connected to other processes: only the hub is away. A retained message is accepted unless the transport
        is closed: the newest value of each topic is stored, for at most 10,000 topics and 16 MB, and sent when the
        connection is back (T4). Two options are for topics that other clients change as well. ``remember`` False: it is
        not stored here; without a connection it is refused. ``shared``: if the other end has a different value after an
        outage, that counts as newer than ours, and stays (T9). ``urgent`` gives commands and flags priority where the
        backend can. Raises TransportError for a topic that is not allowed.
        """
        check_topic(topic)
        if not isinstance(payload, bytes):
            raise TransportError(f"payload of {topic} must be bytes, not {type(payload).__name__}")
        message = Message(topic, payload, qos if type(qos) is QoS else QoS(qos), retain)
        if (forms := self.policy.forms) is None:
            return self._publish(message, urgent=urgent, remember=remember, shared=shared)
        # Several in place of this one, such as a stop with the sender's name and one without; the first decides.
        outcomes = [self._publish(form, urgent=urgent, remember=remember, shared=shared) for form in forms(message)]
        return outcomes[0]

    def _publish(self, message: Message, *, urgent: bool, remember: bool, shared: bool) -> bool:
        with self._publishing:
            if self._state is State.CLOSED:
                self.counters.add("refused")
                return False
            accepted = self._send(message, urgent)
            sent = accepted and self._state is State.CONNECTED  # in CONNECTING a hub still has to get it
            stored = message.retain and remember and self._own.remember(message, sent=sent, shared=shared)
            if accepted:
                self._count_sent()
            else:  # "parked" is the published name of the counter of pending messages
                self.counters.add("parked" if stored else "refused")
            return accepted or stored  # stored by `remember`: it is sent once the connection is back

    def subscribe(
        self,
        filter_: str,
        handler: Handler,
        *,
        qos: QoS = QoS.DELIVERED,
        echo: bool = True,
        direct: bool = False,
        limit: int = QUEUE_LIMIT,
    ) -> Subscription:
        """Deliver retained and live messages that match ``filter_`` to ``handler``, until closed.

        Survives reconnects. ``echo=False`` leaves out what this transport itself publishes (T16). Each subscription
        has a thread and a queue of ``limit`` messages of its own (T13, T14); ``direct=True`` saves both for a handler
        that only forwards the message: it then runs on the receiving thread and must neither block nor subscribe.
        Messages published after this returned are received (T3), if there is a connection.
        """
        (subscription,) = self.subscribe_all({filter_: handler}, qos=qos, echo=echo, direct=direct, limit=limit)
        return subscription

    def subscribe_all(
        self,
        handlers: Mapping[str, Handler],
        *,
        qos: QoS = QoS.DELIVERED,
        echo: bool = True,
        direct: bool = False,
        limit: int = QUEUE_LIMIT,
    ) -> list[Subscription]:
        """Subscribe to each filter with its handler; wait once for all of them."""
        for filter_ in handlers:
            check_filter(filter_)
            if self.as_published and echo:
                raise TransportError(f"an as-published connection never echoes: subscribe {filter_} with echo=False")
        subscriptions = [
            Subscription(self, filter_, handler, qos=QoS(qos), echo=echo, direct=direct, limit=limit)
            for filter_, handler in handlers.items()
        ]
        with self._subscriptions.lock:
            if self._state is State.CLOSED:
                for subscription in subscriptions:
                    subscription._stop()
                raise TransportError(f"transport {self.client_id} is closed")
            for subscription in subscriptions:
                self._subscriptions.add(subscription)
        self._declare_all(subscriptions)
        return subscriptions

    def ask(self, topics: Collection[str]) -> None:
        """Let the retained messages of ``topics`` be delivered to the matching subscriptions; wait for a limited time.

        Some brokers send retained messages only to subscriptions of exact names; other backends do nothing here.
        """
        del topics

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    # -- for backends

    def _set_state(self, state: State) -> None:
        """Set the state, and notify the watchers of a change. A closed transport stays closed until it is opened."""
        with self._changing:
            if state is self._state or (self._state is State.CLOSED and state is State.CONNECTED):
                return
            if state is State.CONNECTED:
                self.problem = ""
                self.counters.add("connected")
            self._state = state
            if state is State.CONNECTED:
                self._connected.set()
            else:
                self._connected.clear()
            for watcher in list(self._watchers):
                try:
                    watcher(state)
                except Exception:  # foreign code on our thread
                    log.exception("a state watcher of %s failed", self.client_id)

    def _renew(self) -> None:
        """Begin a new connection; backends call this before its first message is offered."""
        for subscription in self._subscriptions:
            subscription.renew()

    def _sync_retained(self, known_topics: Collection[str]) -> None:
        """Send our pending retained messages, then our others not on the other end's ``known_topics`` (T9)."""
        with self._publishing:
            self._own.send_again(known_topics, lambda message: self._send(message, False))

    def _initial_sync(self, known_topics: Collection[str]) -> None:
        """Finish a new connection that has its subscriptions: send what the other end lacks, and set CONNECTED.

        Until CONNECTED, the ``_send`` of a backend that calls this accepts only what is sent here (``_own.syncing``).
        Retained messages that are published meanwhile become pending; they are sent here last, after CONNECTED.
        """
        self._sync_retained(known_topics)
        self._set_state(State.CONNECTED)
        self._sync_retained(self._own.keys())

    def _forget(self, subscription: Subscription) -> None:
        if self._subscriptions.remove(subscription):
            self._undeclare(subscription)

    @abstractmethod
    def _open(self, timeout: float) -> None:
        """Start connecting. Once subscriptions are in place, call ``_initial_sync``, or do its work (as Zenoh does)."""

    @abstractmethod
    def _close(self, will: Message | None) -> None:
        """Send ``will`` if given, disconnect, and release every thread, socket and file."""

    @abstractmethod
    def _send(self, message: Message, urgent: bool) -> bool:
        """Send one message within a bounded time; False if it cannot be sent now."""

    def _declare_all(self, subscriptions: Sequence[Subscription]) -> None:
        """Declare each subscription; a backend may wait once for all."""
        for subscription in subscriptions:
            self._declare(subscription)

    @abstractmethod
    def _declare(self, subscription: Subscription) -> None:
        """Activate a subscription in ``_subscriptions``; wait, for a limited time, until it is certainly active."""

    @abstractmethod
    def _undeclare(self, subscription: Subscription) -> None:
        """Deactivate ``subscription``, which is no longer in ``_subscriptions``."""
