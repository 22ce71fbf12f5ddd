"""A server's connection to the broker, for use on an event loop."""

from __future__ import annotations

import asyncio
import logging
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Final

from pebble.errors import TransportError
from pebble.extensions.operator.client.named_topics import NamedTopics
from pebble.extensions.operator.notices import PrintingThread
from pebble.transports import Message, MqttSettings, QoS, State, Subscription, Transport, create

log = logging.getLogger(__name__)

Handler = Callable[[Message, float], None]  # the message, and the monotonic time at which it arrived

MAX_MESSAGES: Final = 10_000  # on their way to the event loop
MAX_BYTES: Final = 64 << 20  # of their payloads
ANSWER_S: Final = 0.25  # a broker that acknowledges nothing for longer would deliver commands late, all at once
_DELIVER_S: Final = 0.01  # for messages at a time: other tasks must not wait for a flood of them


def problem_of(transport: Transport) -> str:
    """Return why nothing can be sent now, in one line; empty if it can."""
    if transport.state is not State.CONNECTED:
        return transport.problem or "not connected yet"
    return "it does not answer" if transport.outgoing.stalled_s > ANSWER_S else ""


class Arrived:
    """A bounded queue of messages for the event loop. Any thread may put, and never waits."""

    def __init__(self) -> None:
        self.dropped = 0
        self._waiting: deque[tuple[Handler, Message, float]] = deque()
        self._bytes = 0
        self._lock = threading.Lock()  # guards these

    def put(self, handler: Handler, message: Message, at: float) -> None:
        """Queue a message; drop it if there is no room."""
        size = len(message.payload)
        with self._lock:
            if len(self._waiting) < MAX_MESSAGES and self._bytes + size <= MAX_BYTES:
                self._bytes += size
                self._waiting.append((handler, message, at))
                return
            self.dropped += 1
        if self.dropped & (self.dropped - 1) == 0:  # the 1st, 2nd, 4th, 8th …
            log.warning("%d messages dropped, the last on %s: too many at once", self.dropped, message.topic)

    def get(self) -> tuple[Handler, Message, float] | None:
        """Return the oldest message; None if there is none."""
        with self._lock:
            if not self._waiting:
                return None
            handler, message, at = self._waiting.popleft()
            self._bytes -= len(message.payload)
            return handler, message, at


class Broker:
    """A connection to the broker whose handlers and watchers run on the event loop.

    Subscribing waits for the broker, so it happens on another thread.
    """

    def __init__(self, settings: MqttSettings, name: str = "pebble-web") -> None:
        """Store the settings. ``name``: the client's name in the broker's log."""
        self.transport: Transport = create("mqtt", f"{name}-{secrets.token_hex(4)}", settings)
        self.transport.on_state(lambda _state: self._call(self._notify))
        self._loop: asyncio.AbstractEventLoop | None = None
        self._watchers: list[Callable[[], None]] = []
        self._arrived = Arrived()  # messages that wait for :meth:`deliver`
        self._woken = False  # the event loop was told to call :meth:`deliver`
        self._printing: PrintingThread | None = None
        #: True for the base topic of a robot that takes commands only with a name.
        self.is_named: Callable[[str], bool] = lambda _base: False
        self.names = NamedTopics(settings.username or "", lambda base: self.is_named(base))
        self.transport.policy.forms = self.names.forms  # puts the account into the topics of commands to such a robot

    @property
    def loop(self) -> asyncio.AbstractEventLoop:
        assert self._loop is not None, "the connection is not open"  # noqa: S101
        return self._loop

    @property
    def connected(self) -> bool:
        return self.transport.state is State.CONNECTED

    @property
    def dropped(self) -> int:
        """Return how many messages were dropped because too many came at once."""
        return self._arrived.dropped

    @property
    def problem(self) -> str:
        """Return why nothing can be sent now, in one line; empty if it can."""
        return problem_of(self.transport)

    @property
    def not_received(self) -> str:
        """Return what cannot be received although the connection is open, and why; empty if nothing."""
        return self.transport.not_received if self.connected else ""

    async def open(self) -> None:
        """Start connecting, and wait briefly for success. Raises TransportError for settings that can never work."""
        self._loop = asyncio.get_running_loop()
        await asyncio.to_thread(self.transport.open, 2.0)

    async def close(self) -> None:
        await asyncio.to_thread(self.transport.close)
        if self._printing is not None:
            self._printing.close(0.0)

    def on_state(self, watcher: Callable[[], None]) -> None:
        """Call ``watcher`` whenever the connection is made or lost."""
        self._watchers.append(watcher)

    def report(self, say: Callable[[str], None]) -> None:
        """Give ``say`` a line if there is no connection, and from now on when it is lost, and when it is made again.

        On a thread: a terminal that stands still holds up no message.
        """
        reported = True  # the state in the last line
        printing = self._printing = PrintingThread()

        def note() -> None:
            nonlocal reported
            if self.connected is not reported and self.transport.state is not State.CLOSED:
                reported = self.connected
                line = "connected to the broker" if reported else f"{self.problem} (trying again)"
                printing.run(partial(say, line))

        self.on_state(note)
        note()

    def publish(
        self,
        topic: str,
        payload: bytes,
        *,
        retain: bool = False,
        remember: bool = True,
        qos: QoS = QoS.DELIVERED,
        by: str = "",
    ) -> bool:
        """Publish with priority (``urgent``); return False without a connection, or for an invalid topic.

        ``remember`` False: do not publish it again if the broker loses it, since others may have published a newer
        value. ``by``: the person for whom it is sent; robots that take only commands with a sender's name read it.
        """
        try:
            signed = self.names.signed(topic, payload, by)
            return self.transport.publish(topic, signed, qos=qos, retain=retain, urgent=True, remember=remember)
        except TransportError as error:  # parts of topics come from robots and pages: what else is due must go on
            log.warning("not published: %s", error)
            return False

    async def subscribe(self, filter_: str, handler: Handler, *, deferred: bool = False) -> Subscription:
        """Deliver messages that match ``filter_`` until it is unsubscribed.

        ``deferred``: deliver with the next call of ``deliver``, or before the next message that is not deferred. Waking
        the event loop for each heartbeat of a hundred robots costs more than the heartbeats do.
        """

        def take(message: Message) -> None:
            self._arrived.put(handler, message, time.monotonic())
            if not deferred:
                self._wake()

        return await asyncio.to_thread(self.transport.subscribe, filter_, take, qos=QoS.DELIVERED, direct=True)

    def deliver(self) -> None:
        """Deliver the queued messages in order; if that takes long, let other tasks run in between."""
        self._woken = False
        end = time.monotonic() + _DELIVER_S
        while (arrived := self._arrived.get()) is not None:
            handler, message, at = arrived
            try:
                handler(message, at)
            except Exception:  # one message must not hold back the others
                log.exception("a message on %s", message.topic)
            if time.monotonic() > end:
                self._wake()
                return

    def _wake(self) -> None:
        if not self._woken:
            self._woken = True
            self._call(self.deliver)

    async def unsubscribe(self, subscription: Subscription) -> None:
        """Stop delivery; a message that has already arrived may still be delivered."""
        await asyncio.to_thread(subscription.close)

    def _notify(self) -> None:
        for watcher in self._watchers:
            watcher()

    def _call(self, function: Callable[..., None], *arguments: object) -> None:
        """Call ``function`` on the event loop, from another thread; do nothing if the loop has ended."""
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(function, *arguments)
