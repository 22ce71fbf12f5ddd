"""How much a gateway passes in a second: what is sent to one robot, or by it, must not hold up the others. Pure."""

from collections.abc import Callable, Container
from math import inf

from pebble.contract import ESTOP, INCOMING, codec
from pebble.contract.codec import MAX_COMMAND_BYTES
from pebble.errors import PayloadError
from pebble.transports import Message

MOST_EACH, MOST_TOGETHER = 500, 2000  # messages of a topic, and of a robot, in a second, in each direction
MOST_STOPS = 50  # of a sender, to one robot
LARGEST = 1024 * 1024  # bytes that a robot sends at once; the brokers of `pebble fleet` take no more
_TOPICS, _WAITING = 4096, 64  # that are counted by themselves in a second, and of which the newest one waits
_SENDERS = 16  # of stops of one robot in a second, that are counted by themselves


class Pace:
    """The newest message of each topic that is beyond it waits for the next second, so the last one is never lost.

    It is called on one thread; but :meth:`due` may be on another.
    """

    def __init__(self, clock: Callable[[], float], each: int, together: float = inf) -> None:
        self._clock, self._each, self._together = clock, each, together
        self._second = self._passed = 0
        self._counts: dict[str, int] = {}
        self._waiting: dict[str, tuple[int, Message]] = {}  # and the second in which each has come

    def takes(self, message: Message, key: str) -> bool:
        """True if this one passes now; ``key``: its topic, or what it is counted with. Hot."""
        second, counts = int(self._clock()), self._counts
        if second != self._second:
            self._second, self._passed = second, 0
            counts.clear()
        count = counts.get(key, 0)
        if not count and len(counts) >= _TOPICS:
            key, count = "", counts.get("", 0)
        if count < self._each and self._passed < self._together:
            counts[key] = count + 1
            self._passed += 1
            if self._waiting:
                self._waiting.pop(key, None)  # older than this one
            return True
        if key in self._waiting or len(self._waiting) < _WAITING:
            self._waiting[key] = second, message
        return False

    def due(self) -> list[Message]:
        """Return those whose second has come."""
        if not self._waiting:
            return []
        second = int(self._clock())
        due = [key for key, (came, _) in list(self._waiting.items()) if came != second]
        found = [self._waiting.pop(key, None) for key in due]
        return [one[1] for one in found if one is not None]


class Senders:
    """What a stop is counted with: its topic and who it claims to be from, so a flood of one hides none of another.

    Of a robot that is ``known``. All others count as one, and so do the senders of a robot beyond a few in a second.
    """

    def __init__(self, known: Container[str], clock: Callable[[], float]) -> None:
        self._known, self._clock = known, clock
        self._second = 0
        self._senders: dict[str, set[str]] = {}  # of this second, by robot

    def key(self, message: Message) -> str:
        base = message.topic.partition(f"/{INCOMING}/")[0]
        if base not in self._known:
            return ""
        second = int(self._clock())
        if second != self._second:
            self._second = second
            self._senders.clear()
        senders, sender = self._senders.setdefault(base, set()), f"{message.topic} {_claim(message.payload)}"
        if sender in senders or len(senders) < _SENDERS:
            senders.add(sender)
            return sender
        return base


def _claim(payload: bytes) -> str:
    try:
        return str(codec.decode(ESTOP, payload).by) if len(payload) <= MAX_COMMAND_BYTES else ""
    except PayloadError:
        return ""
