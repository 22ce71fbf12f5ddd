"""Messages on their way from threads of the transport to the event loop. It never waits for room."""

import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Final

from pebble.transports import Message

log = logging.getLogger(__name__)

Handler = Callable[[Message, float], None]  # the message, and the monotonic time at which it arrived

MAX_MESSAGES: Final = 10_000
MAX_BYTES: Final = 64 << 20  # of their payloads
MAX_DEFERRED: Final = 5_000  # heartbeats, which come again, take no room from what is sent once


class Arrived:
    """Any thread puts, the event loop alone gets."""

    def __init__(self) -> None:
        self.dropped = 0
        self._waiting: deque[tuple[Handler, Message, float]] = deque()
        self._bytes = 0
        self._lock = threading.Lock()  # guards these

    def put(self, handler: Handler, message: Message, at: float, *, deferred: bool = False) -> bool:
        """False if there is no room for it."""
        size = len(message.payload)
        most = MAX_DEFERRED if deferred else MAX_MESSAGES
        with self._lock:
            if len(self._waiting) < most and self._bytes + size <= MAX_BYTES:
                self._bytes += size
                self._waiting.append((handler, message, at))
                return True
            self.dropped += 1
        if self.dropped & (self.dropped - 1) == 0:  # the 1st, 2nd, 4th, 8th …
            log.warning("%d messages dropped, the last on %s: too many at once", self.dropped, message.topic)
        return False

    def get(self) -> tuple[Handler, Message, float] | None:
        """The oldest; None if there is none."""
        with self._lock:
            if not self._waiting:
                return None
            arrived = self._waiting.popleft()
            self._bytes -= len(arrived[1].payload)
            return arrived
