"""Hands a transport's own messages to its own direct handlers, on a thread of their own.

Zenoh delivers to subscribers of the same session inside ``put()``. A direct handler called there would run under the
publisher's lock, and two that publish to each other would wait for each other for ever.
"""

from __future__ import annotations

import threading
from collections import deque

from pebble.transports.base import QUEUE_LIMIT, Message, Subscription
from pebble.transports.counters import Counters


class Echo:
    """Its thread starts with the first message, and ends with ``close()``."""

    def __init__(self, counters: Counters) -> None:
        self._counters = counters
        self._arrived = threading.Condition()
        self._queue: deque[tuple[Subscription, Message]] = deque()
        self._thread: threading.Thread | None = None
        self._closed = False

    def put(self, subscription: Subscription, message: Message) -> None:
        with self._arrived:
            if self._closed:
                return
            if len(self._queue) >= QUEUE_LIMIT:
                self._queue.popleft()
                self._counters.add("dropped")
            self._queue.append((subscription, message))
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
