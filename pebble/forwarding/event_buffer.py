"""Buffers events (QoS 1, not retained) during an outage, a bounded number of them."""

import threading
from collections import deque
from collections.abc import Callable

from msgspec import Struct

from pebble.transports import Message, State, Transport
from pebble.transports.counters import Counters

LIMIT = 256  # events of an outage; the oldest is dropped
#: A dead connection accepts messages until its silence is detected (2 s by default). Events published so shortly before
#: the loss are sent again: QoS 1 allows duplicates, and no loss.
RESEND_S = 3.0


class _Event(Struct, eq=False):
    message: Message
    sent_at: float = 0.0


class EventBuffer:
    """A buffer that sends events in order; during an outage they wait, and the oldest is dropped when it is full."""

    def __init__(self, transport: Transport, counters: Counters, *, clock: Callable[[], float]) -> None:
        self._transport, self._counters, self._clock = transport, counters, clock
        self._lock = threading.Lock()
        self._waiting: deque[_Event] = deque()
        self._recent: deque[_Event] = deque(maxlen=LIMIT)  # sent on this connection, which may have lost the last ones
        self._lost_at: float | None = None  # when the connection was lost, until flush()
        #: True if a message may be sent now, where the link is thin; others wait.
        self.has_room: Callable[[Message], bool] | None = None

    def watch(self, state: State) -> None:
        """Follow the transport's state."""
        if state is not State.CONNECTED and self._lost_at is None:
            self._lost_at = self._clock()

    def send(self, message: Message) -> None:
        self.hold(message)
        self.resume()

    def hold(self, message: Message) -> None:
        """Keep ``message`` until the next :meth:`resume` or :meth:`flush`."""
        with self._lock:
            self._waiting.append(_Event(message))
            if len(self._waiting) > LIMIT:
                self._waiting.popleft()
                self._counters.add("events_dropped")

    def resume(self) -> None:
        """Send the waiting events, in order; on a new connection after a loss only :meth:`flush` sends them."""
        with self._lock:
            if self._lost_at is None or self._transport.state is not State.CONNECTED:
                self._drain()  # Zenoh accepts messages while the hub is away

    def flush(self) -> None:
        """Send, on a new connection, the events that the last connection may have lost, then those that wait."""
        with self._lock:
            if self._lost_at is not None:
                recent = [event for event in self._recent if 0 <= self._lost_at - event.sent_at <= RESEND_S]
                waiting = recent + list(self._waiting)
                self._counters.add("events_dropped", max(0, len(waiting) - LIMIT))
                self._waiting = deque(waiting[-LIMIT:])
                self._lost_at = None
            self._recent.clear()
            self._drain()

    def clear(self) -> None:
        with self._lock:
            self._waiting.clear()
            self._recent.clear()

    def _drain(self) -> None:
        while self._waiting:
            event = self._waiting[0]
            message = event.message
            if self.has_room is not None and not self.has_room(message):
                return
            if not self._transport.publish(message.topic, message.payload, qos=message.qos):
                return
            event.sent_at = self._clock()
            self._recent.append(self._waiting.popleft())
