"""Messages on their way from the transport's thread to the event loop. Neither locks nor waits."""

import logging
from collections import deque
from collections.abc import Callable
from typing import Final

from pebble.transports import Message

log = logging.getLogger(__name__)

Handler = Callable[[Message, float], None]  # the message, and the monotonic time at which it arrived

MAX_MESSAGES: Final = 10_000  # that wait for the program; a new one is dropped
MAX_BYTES: Final = 64 << 20  # of their payloads
MAX_DEFERRED: Final = 5_000  # heartbeats, which come again, take no room from what is sent once


class Arrived:
    """One thread alone puts, another alone gets."""

    def __init__(self) -> None:
        self.dropped = 0
        self._waiting: deque[tuple[Handler, Message, float]] = deque()
        self._put_bytes = self._got_bytes = 0  # each written by one thread

    def put(self, handler: Handler, message: Message, at: float, *, deferred: bool = False) -> bool:
        """False if there is no room for it."""
        size = len(message.payload)
        most = MAX_DEFERRED if deferred else MAX_MESSAGES
        if len(self._waiting) >= most or self._put_bytes - self._got_bytes + size > MAX_BYTES:
            self.dropped += 1
            if self.dropped & (self.dropped - 1) == 0:  # the 1st, 2nd, 4th, 8th …
                log.warning("%d messages dropped, the last on %s: too many at once", self.dropped, message.topic)
            return False
        self._put_bytes += size
        self._waiting.append((handler, message, at))
        return True

    def get(self) -> tuple[Handler, Message, float] | None:
        """The oldest; None if there is none."""
        if not self._waiting:
            return None
        one = self._waiting.popleft()
        self._got_bytes += len(one[1].payload)
        return one
