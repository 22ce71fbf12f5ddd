"""Delivers a transport's own messages to its own direct handlers."""

import threading

from pebble.transports.base import QUEUE_BYTES, QUEUE_LIMIT, Message, Subscription
from pebble.transports.bounds import BoundedQueue
from pebble.transports.counters import Counters


class LoopbackQueue:
    """A queue that hands a transport's own messages to its own direct handlers, on a thread of its own.

    The thread starts with the first message. Zenoh delivers to subscribers of the same session inside ``put()``. A
    direct handler called there would run under the publisher's lock, and two that publish to each other would deadlock.
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
