"""The messages of a client to the hub: its will, its retained messages, and queries for retained messages."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable

import zenoh

from pebble.transports.base import Message, QoS, Subscription
from pebble.transports.own_retained import OwnRetained
from pebble.transports.zenoh import wire
from pebble.transports.zenoh.callbacks import direct
from pebble.transports.zenoh.keymap import filter_to_key, key_to_topic, topic_to_key
from pebble.transports.zenoh.presence import HubWatch
from pebble.transports.zenoh.publishers import remember_first

HUB_ANSWER_S = 1.0
FETCH_S = 0.7  # the longest wait for the hub's retained messages, which it may delay for half a second
GOODBYE_S = 0.3  # the longest wait for an answer when closing


class HubConnection:
    """The connections to hubs, one after the other: a new one for each hub that `watch` sees. ``name``: our session."""

    def __init__(
        self, client_id: str, will: Message | None, own: OwnRetained, count: Callable[[], object], account: str
    ) -> None:
        self._account = account  # under which the hub knows this client; "": a process of this machine
        self._will = None if will is None else wire.Will.of(will, client_id)
        self._own, self._count_received = own, count  # ``count()`` counts a message that was received
        # Retained topics we have removed, in case a hub that was ending did not receive the removal.
        self._removed: dict[str, None] = {}
        self.retained_count = 0  # of retained messages published so far
        self.name = ""
        self.watch = HubWatch()
        self.lock = threading.Lock()  # no answer of a connection is offered after the next one began
        self._connection = 0  # the number of the present one

    def open(self) -> None:
        """Begin a connection for a client that was opened, perhaps again."""
        self.name, self.watch = "", HubWatch()

    def renew(self) -> None:
        """Begin a new connection: answers to older queries are dropped from now on. The lock is held."""
        self._connection += 1

    # -- sending

    def put(self, session: zenoh.Session, message: Message, *, again: bool) -> None:
        """Send a retained message to the hub, before the live one, so that a subscription in between gets one of them.

        ``again``: the message was published before, and the running siblings (other peers) have it.
        """
        if not again:
            self.retained_count += 1
        if message.payload:
            self._removed.pop(message.topic, None)
        else:
            remember_first(self._removed, message.topic, None)
        self._put(session, message, 0 if again else self.retained_count)  # 0: sent again

    def _put(self, session: zenoh.Session, message: Message, retained_count: int) -> None:
        stamp = wire.Stamp(message.qos, retained_count, self.name)
        session.put(wire.RETAINED + topic_to_key(message.topic), message.payload, attachment=stamp.pack(), **wire.BLOCK)

    def put_removals(self, session: zenoh.Session, topics: Iterable[str]) -> None:
        """Send again the removals of those of ``topics`` that this client has removed."""
        for topic in [topic for topic in topics if topic in self._removed]:
            self._put(session, Message(topic, b"", QoS.DELIVERED, retain=True), self.retained_count)

    # -- queries

    def hello(self) -> bytes:
        """Return a hello message with our will and the digests of our retained messages."""
        removals: dict[str, int | None] = {topic_to_key(topic): None for topic in self._removed}
        retained: dict[str, int | None] = {
            topic_to_key(topic): wire.digest(message.payload) for topic, message in self._own.items() if message.payload
        }
        return wire.encode(wire.Hello(self.name, self.retained_count, self._will, removals | retained))

    def greet(self, session: zenoh.Session, hello: bytes, timeout: float) -> set[str] | None:
        """Send a hello; return the topics that the hub lacks, or None if no hub answers in time."""
        answer = wire.ask(session, wire.asked(wire.HELLO, self._account), hello, timeout)
        return None if answer is None else {key_to_topic(key) for key in wire.decode_keys(answer)}

    def leave(self, session: zenoh.Session) -> None:
        """Tell the hub to forget our will."""
        wire.ask(session, wire.asked(wire.BYE, self._account), wire.encode(self.name), GOODBYE_S)

    def fetch(self, session: zenoh.Session, subscriptions: Iterable[Subscription], counts: dict[str, int]) -> None:
        """Ask for retained messages and wait for them, so that none arrives after messages published later.

        ``counts``: how many retained messages each other process has sent; the hub answers once it has received those.
        """
        end = time.monotonic() + FETCH_S
        for answered in [self._query(session, subscription, counts) for subscription in subscriptions]:
            answered.wait(max(0.0, end - time.monotonic()))

    def _query(self, session: zenoh.Session, subscription: Subscription, counts: dict[str, int]) -> threading.Event:
        """Ask for one subscription's retained messages; return an event set at their end. ``counts``: see `fetch`."""
        connection, answered = self._connection, threading.Event()

        def take(reply: zenoh.Reply) -> None:
            sample = reply.ok
            if sample is None or sample.attachment is None:
                return
            stamp = wire.Stamp.unpack(sample.attachment.to_bytes())
            if stamp.origin == self.name and not subscription.echo:
                return
            self._count_received()
            topic = key_to_topic(str(sample.key_expr).removeprefix(wire.RETAINED))
            qos = min(stamp.qos, subscription.qos)
            message = Message(topic, sample.payload.to_bytes(), qos, retain=True, retain_requested=True)
            with self.lock:
                if connection == self._connection:
                    subscription.offer(message)

        session.get(
            wire.RETAINED + filter_to_key(subscription.filter),
            direct(take, answered.set),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=wire.RETAINED_ANSWER_S,
            payload=wire.encode({name: count for name, count in counts.items() if count}),
            **wire.BLOCK,
        )
        return answered
