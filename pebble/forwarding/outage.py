"""What must survive the short life of a connection without being kept: events, a bounded number of them."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from pebble.transports import Message, State, Transport
from pebble.transports.counters import Counters

LIMIT = 256
#: A dead link takes messages until its silence is noticed (2 s by default). What was handed over so shortly before the
#: loss is sent again: twice is allowed at this quality, never is not.
DOUBT_S = 3.0


@dataclass(frozen=True, slots=True)
class _Sent:
    at: float
    message: Message


class EventBuffer:
    """Sends events in order; while the other side is away they wait, and the oldest is dropped for the newest."""

    def __init__(
        self,
        transport: Transport,
        counters: Counters,
        *,
        clock: Callable[[], float] = time.monotonic,
        limit: int = LIMIT,
    ) -> None:
        self._transport, self._counters, self._clock, self._limit = transport, counters, clock, limit
        self._lock = threading.Lock()
        self._waiting: deque[Message] = deque()
        self._doubtful: deque[_Sent] = deque(maxlen=limit)
        self._lost_at: float | None = None  # when the connection went, until flush()

    def watch(self, state: State) -> None:
        """A watcher for the transport's state."""
        if state is not State.CONNECTED and self._lost_at is None:
            self._lost_at = self._clock()

    def send(self, message: Message) -> None:
        with self._lock:
            self._append(message)
            if self._lost_at is None or self._transport.state is not State.CONNECTED:
                self._drain()  # a Zenoh fabric whose hub is away still takes it

    def hold(self, message: Message) -> None:
        """Keep ``message`` for the next :meth:`flush`."""
        with self._lock:
            self._append(message)

    def flush(self) -> None:
        """The connection is there (again): send what waits, after what may have been lost with the last one."""
        with self._lock:
            if self._lost_at is not None:
                doubt = [sent.message for sent in self._doubtful if 0 <= self._lost_at - sent.at <= DOUBT_S]
                waiting = doubt + list(self._waiting)
                self._counters.add("events_dropped", max(0, len(waiting) - self._limit))
                self._waiting = deque(waiting[-self._limit :])
                self._lost_at = None
            self._doubtful.clear()
            self._drain()

    def clear(self) -> None:
        with self._lock:
            self._waiting.clear()
            self._doubtful.clear()

    def _append(self, message: Message) -> None:
        self._waiting.append(message)
        if len(self._waiting) > self._limit:
            self._waiting.popleft()
            self._counters.add("events_dropped")

    def _drain(self) -> None:
        while self._waiting:
            message = self._waiting[0]
            if not self._transport.publish(message.topic, message.payload, qos=message.qos):
                return
            self._doubtful.append(_Sent(self._clock(), self._waiting.popleft()))
