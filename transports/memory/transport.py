"""A network inside one process: the reference for the promises' meaning, and a fast substitute in tests.

`MemoryHub` acts as the broker. It can be stopped and started, lose its retained messages, and crash a client.
"""

from __future__ import annotations

import itertools
import threading
from collections import deque
from dataclasses import dataclass

from msgspec.structs import replace

from pebble.transports import clock
from pebble.transports.base import Message, State, Subscription, Transport

INBOX_LIMIT = 10_000  # undelivered messages per client


class MemoryHub:
    """A broker for `MemoryTransport`s; pass it as their settings. It runs from the start."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.retained: dict[str, Message] = {}
        self.publishers: dict[str, MemoryTransport] = {}  # of the retained message of a topic
        self.era: int | None = 1  # counts its runs; None while it is stopped
        self._eras = itertools.count(2)
        self._clients: list[MemoryTransport] = []  # all that are open, connected or not

    def __reduce__(self) -> tuple[type[MemoryHub], tuple[()]]:
        return MemoryHub, ()  # in another process it is another hub

    def start(self) -> None:
        with self.lock:
            self.era = next(self._eras)
            self._wake_all()

    def stop(self, *, forget: bool = False) -> None:
        """Disconnect every client; ``forget`` also removes the retained messages."""
        with self.lock:
            self.era = None
            if forget:
                self.retained.clear()
                self.publishers.clear()
            self._wake_all()

    def crash(self, client: MemoryTransport) -> None:
        """End ``client`` as a crash would, and publish its will."""
        with self.lock:
            self.leave(client)
            client.vanish()
            if client.will is not None:
                self.distribute(client.will, client)

    def enter(self, client: MemoryTransport) -> None:
        with self.lock:
            self._clients.append(client)

    def leave(self, client: MemoryTransport) -> None:
        with self.lock:
            self._clients = [other for other in self._clients if other is not client]

    def distribute(self, message: Message, publisher: MemoryTransport) -> None:
        """Retain ``message`` if it asks for that, and hand it to every connected client."""
        with self.lock:
            if message.retain and message.payload:
                self.retained[message.topic], self.publishers[message.topic] = message, publisher
            elif message.retain:
                self.retained.pop(message.topic, None)
            live = replace(message, retain=False, retain_requested=message.retain, waiting_since=self.now())
            for client in self._clients:
                if client._present:
                    client.receive(_Delivery(live, publisher))

    def now(self) -> float | None:
        """Return the time of a delivery, since boot; None in subclasses for tests that simulate time."""
        return clock.since_boot()

    def _wake_all(self) -> None:
        for client in self._clients:
            client.wake()


@dataclass(frozen=True, slots=True)
class _Delivery:
    message: Message
    publisher: MemoryTransport
    only: Subscription | None = None  # retained messages go to one subscription


class MemoryTransport(Transport):
    """A client of a `MemoryHub`. It has a receiving thread of its own, as real transports have."""

    def __init__(self, client_id: str, settings: MemoryHub, *, will: Message | None = None) -> None:
        super().__init__(client_id, will=will)
        self._hub = settings  # all settings of this transport are the hub
        self._inbox: deque[_Delivery] = deque()
        self._changed = threading.Condition(settings.lock)
        self._attached: int | None = None  # the era of the hub we are connected in; None: not connected
        self._stopping = False
        self._thread: threading.Thread | None = None

    # -- what the hub calls, with its lock held

    def receive(self, delivery: _Delivery) -> None:
        if len(self._inbox) >= INBOX_LIMIT:
            self._inbox.popleft()
            self.counters.add("dropped")
        self._inbox.append(delivery)
        self._changed.notify_all()

    def wake(self) -> None:
        self._changed.notify_all()

    def vanish(self) -> None:
        """Stop without publishing the will."""
        self._stopping, self._attached = True, None
        self._inbox.clear()
        self._changed.notify_all()

    # -- the interface to base

    def _open(self, timeout: float) -> None:  # noqa: ARG002  (base waits)
        self._stopping = False
        self.problem = "the hub is away"  # until it is found
        self._hub.enter(self)
        self._thread = threading.Thread(target=self._run, name=f"pebble-memory {self.client_id}", daemon=True)
        self._thread.start()

    def _close(self, will: Message | None) -> None:
        with self._hub.lock:
            if will is not None and self._present:
                self._hub.distribute(will, self)
            self._hub.leave(self)
            self.vanish()  # which also ends the receiving thread
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(1.0)

    def _send(self, message: Message, urgent: bool) -> bool:  # noqa: ARG002  (nothing to overtake)
        with self._hub.lock:
            if not (self._present and (self._state is State.CONNECTED or self._own.syncing)):
                return False
            self._hub.distribute(message, self)
            return True

    def _declare(self, subscription: Subscription) -> None:
        with self._hub.lock:
            if self._present:
                self._send_retained(subscription)

    def _undeclare(self, subscription: Subscription) -> None:
        """Do nothing: the hub knows no filters."""

    @property
    def _present(self) -> bool:
        """True if this client is connected to the hub, which has not stopped since."""
        return self._attached is not None and self._attached == self._hub.era

    def _send_retained(self, subscription: Subscription) -> None:
        for topic, message in list(self._hub.retained.items()):
            copy = replace(message, retain=True, retain_requested=True)
            if subscription in self._subscriptions.matching(topic):
                self.receive(_Delivery(copy, self._hub.publishers[topic], subscription))

    # -- the receiving thread

    def _run(self) -> None:
        while True:
            with self._hub.lock:
                while not (self._stopping or self._inbox or self._attached != self._hub.era):  # era: hub changed
                    self._changed.wait()
                if self._stopping:
                    return
            self._work()

    def _work(self) -> None:
        """React to the hub's start or stop, or deliver the message that has waited longest."""
        with self._hub.lock:
            hub_changed = self._attached != self._hub.era
            delivery = self._inbox.popleft() if self._inbox and not hub_changed else None
        if delivery is not None:
            self._deliver(delivery)
        elif hub_changed and self._attached is not None:
            self._on_hub_stopped()
        elif hub_changed:
            self._connect()

    def _deliver(self, delivery: _Delivery) -> None:
        self.count_received()
        message = delivery.message
        targets = self._subscriptions.matching(message.topic) if delivery.only is None else [delivery.only]
        for subscription in targets:
            if subscription.echo or delivery.publisher is not self:
                subscription.offer(message)

    def _on_hub_stopped(self) -> None:
        with self._hub.lock:
            self._attached = None
            self._inbox.clear()
        self.problem = "the hub is away"
        self._set_state(State.CONNECTING)

    def _connect(self) -> None:
        self._renew()  # base: before the first message of a connection is offered
        with self._hub.lock:
            if self._stopping or self._hub.era is None:  # closed, or the hub was stopped, meanwhile
                return
            self._attached = self._hub.era
            retained_topics = set(self._hub.retained)
            for subscription in self._subscriptions:
                self._send_retained(subscription)
        self._initial_sync(retained_topics)


TRANSPORT = MemoryTransport
