"""The queue of items that wait to be written into files."""

import json
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from operator import attrgetter
from typing import Any, Final, NamedTuple

from pebble.extensions.recordings.recorder.clock import RecordingClock
from pebble.extensions.recordings.recorder.lane import Item
from pebble.extensions.recordings.stamps import is_media
from pebble.transports.bounds import BoundedQueue

#: The topic of what happened to the recording itself. Subscriptions with wildcards never deliver such topics.
EVENTS: Final = "$recorder/events"
#: The retained values of a connection are fetched anew: those that are known are no more.
FORGET: Final = "$recorder/forget"
_COST: Final = 300  # bytes of memory that a message takes beside its topic and payload
_MOST_WAITING: Final = 1 << 20  # messages that wait to be written; the oldest is dropped, with an event
_MOST_EVENTS: Final = 1000  # events that wait to be written


class Clocks(NamedTuple):
    """The clocks of a recorder, in nanoseconds."""

    wall_ns: Callable[[], int] = time.time_ns
    boot_ns: Callable[[], int] = lambda: time.clock_gettime_ns(time.CLOCK_BOOTTIME)  # a clock that only Linux has
    awake_ns: Callable[[], int] = time.monotonic_ns  # stands still while the machine is suspended


class Intake:
    """A bounded queue; pictures and sound never displace state. Any thread may add to it."""

    def __init__(self, limit: int, clocks: Clocks, clock: RecordingClock, counters: Counter[str]) -> None:
        self._boot_ns = clocks.boot_ns
        self._clock, self._counters = clock, counters
        self._lock = threading.Lock()
        self._state = BoundedQueue[Item](_MOST_WAITING, limit // 4)
        self._media = BoundedQueue[Item](_MOST_WAITING, limit - limit // 4)
        self._events: deque[Item] = deque(maxlen=_MOST_EVENTS)

    def add(self, topic: str, payload: bytes, qos: int | None, retain: bool | None, retained: str, source: str) -> None:
        """Queue a message, described as in :class:`Item`; count those that are dropped for it."""
        item = Item(self._boot_ns(), topic, payload, qos, retain, retained, source)
        queue = self._media if is_media(payload) else self._state
        with self._lock:
            lost = queue.append(item, len(topic) + len(payload) + _COST)
            self._counters["messages"] += 1
            self._counters["bytes"] += len(payload)
            self._counters["dropped"] += len(lost)

    def note(self, event: str, **about: Any) -> None:
        """Add an event of the recording itself. Messages never displace it; only 1,000 events may wait."""
        boot_ns = self._boot_ns()
        payload = json.dumps({"t": self._clock.at(boot_ns) // 10**6, "event": event, **about}).encode()
        self._events.append(Item(boot_ns, EVENTS, payload, 1, False, ""))
        self._counters[f"event_{event}"] += 1

    def note_gap(self, since_ns: int, why: str, **about: Any) -> None:
        """Add an event: nothing was recorded since ``since_ns`` (since 1970)."""
        now_ns = self._clock.now()
        self.note("gap", since=since_ns // 10**6, until=now_ns // 10**6, why=why, **about)

    def put_back(self, event: Item) -> None:
        self._events.append(event)

    def drop(self, messages: int) -> None:
        """Count messages that were taken from the queue and could not be written."""
        with self._lock:
            self._counters["dropped"] += messages

    def add_order(self, topic: str, source: str) -> None:
        """Queue a request to the writer, such as the ``topic`` FORGET. It is handled in order with the messages."""
        self._events.append(Item(self._boot_ns(), topic, b"", None, None, "", source))

    def take(self) -> list[Item]:
        """Return all waiting items in the order of their arrival."""
        items = [self._events.popleft() for _ in range(len(self._events))]
        with self._lock:
            for waiting in (self._state, self._media):
                items += [waiting.popleft() for _ in range(len(waiting))]
        return sorted(items, key=_when)


_when = attrgetter("boot_ns")
