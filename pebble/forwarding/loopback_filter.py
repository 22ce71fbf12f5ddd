"""Recognises our own messages on a connection to a broker without bridge mode, which sends them back."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

LIMIT = 2000  # messages of one topic that have not come back yet
TOPICS = 4096  # with such messages; beyond it the oldest is dropped
EXPIRY_S = 10.0  # an echo that has not arrived by then never will


class LoopbackFilter:
    """Remembers what was published, by topic and in order, until it comes back."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._out: dict[str, deque[tuple[float, bytes]]] = {}

    def __len__(self) -> int:
        """Topics with messages that have not come back yet."""
        return len(self._out)

    def expect(self, topic: str, payload: bytes) -> None:
        """Call before publishing: the echo may be faster than the return of the call."""
        with self._lock:
            if topic not in self._out and len(self._out) >= TOPICS:
                del self._out[next(iter(self._out))]
            self._out.setdefault(topic, deque(maxlen=LIMIT)).append((self._clock(), payload))

    def forget(self, topic: str) -> None:
        """The newest message on ``topic`` was not sent after all."""
        with self._lock:
            if self._out.get(topic):
                self._out[topic].pop()
                self._tidy(topic)

    def is_echo(self, topic: str, payload: bytes) -> bool:
        """Whether this message is ours. A broker keeps the order of a topic, so earlier ones will not come back."""
        with self._lock:
            out = self._out.get(topic)
            if not out:
                return False
            while out and self._clock() - out[0][0] > EXPIRY_S:
                out.popleft()
            for index, (_, earlier) in enumerate(out):
                if earlier == payload:
                    for _ in range(index + 1):
                        out.popleft()
                    self._tidy(topic)
                    return True
            self._tidy(topic)
            return False

    def _tidy(self, topic: str) -> None:
        if not self._out[topic]:
            del self._out[topic]
