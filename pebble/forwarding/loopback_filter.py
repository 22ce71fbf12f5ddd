"""Recognises our own messages that come back, from a broker without bridge mode or through another bridge."""

import threading
from collections import deque
from collections.abc import Callable
from hashlib import blake2b

LIMIT = 2000  # messages of one topic that have not come back yet
TOPICS = 4096  # with such messages; beyond it the oldest is dropped,
MESSAGES = 20_000  # as it is beyond so many of all topics
EXPIRY_S = 10.0  # an echo that has not arrived by then never will


class LoopbackFilter:
    """A memory of published messages, by topic and in order, until they come back."""

    def __init__(self, clock: Callable[[], float], expiry_s: float = EXPIRY_S) -> None:
        self._clock, self._expiry_s = clock, expiry_s
        self._lock = threading.Lock()
        self.out: dict[str, deque[tuple[float, bytes]]] = {}  # by topic: when each was published, and its digest
        self._messages = 0  # of all topics

    def expect(self, topic: str, payload: bytes) -> None:
        """Expect a message to come back. Call this before publishing: the echo may be faster than a call after it."""
        with self._lock:
            out = self.out.setdefault(topic, deque())
            out.append((self._clock(), _digest(payload)))
            self._messages += 1
            if len(out) > LIMIT:
                self._drop_first(out)
            while len(self.out) > TOPICS or self._messages > MESSAGES:
                self._messages -= len(self.out.pop(next(iter(self.out))))

    def forget(self, topic: str) -> None:
        """Forget the newest message on ``topic``, which could not be sent."""
        with self._lock:
            if self.out.get(topic):
                self.out[topic].pop()
                self._messages -= 1
                self._tidy(topic)

    def is_echo(self, topic: str, payload: bytes) -> bool:
        """True if we sent this message; forgets that message and all earlier ones of its topic.

        A broker keeps the order of a topic, so the earlier ones will not come back.
        """
        with self._lock:
            out = self.out.get(topic)
            if not out:
                return False
            while out and self._clock() - out[0][0] > self._expiry_s:
                self._drop_first(out)
            digest = _digest(payload)
            for index, (_, published_digest) in enumerate(out):
                if published_digest == digest:
                    for _ in range(index + 1):
                        self._drop_first(out)
                    self._tidy(topic)
                    return True
            self._tidy(topic)
            return False

    def _tidy(self, topic: str) -> None:
        if not self.out[topic]:
            del self.out[topic]

    def _drop_first(self, out: deque[tuple[float, bytes]]) -> None:
        out.popleft()
        self._messages -= 1


def _digest(payload: bytes) -> bytes:
    return blake2b(payload, digest_size=16).digest()
