"""A sieve for messages that leave a robot over a thin link: it passes the newest of each stream, as room allows.

Pure: the owner guards it with a lock, and sends what it yields. It never gets stops or other messages *to* the robot,
nor flags and states that must not wait (``prompt``).
"""

from collections.abc import Callable, Iterator
from enum import IntEnum
from math import inf

from msgspec import Struct

from pebble.contract import Kind
from pebble.forwarding.routing import Forward
from pebble.forwarding.subjects import Subject
from pebble.transports import Message, QoS
from pebble.transports.counters import Counters

TOPICS = 512  # whose newest message waits, or is known to have been sent
OVERDUE_S = 10.0  # a message that has waited for so long gives way no more


class Rank(IntEnum):
    """The rank of a message. Rank N waits once N times the link's room is in use: streams first, heartbeats last."""

    STREAM = 1
    STATE = 2
    HEARTBEAT = 4


class Waiting(Struct, frozen=True):
    """The newest message of a topic, not yet sent."""

    rank: Rank
    subject: Subject
    message: Message
    forward: Forward
    since: float  # when the first message of the topic began to wait, of which this one takes the place


class Sieve:
    """A sieve. ``takes(rank, size)`` returns True, and takes room, if a message of so many bytes may be sent now.

    ``stream_s``: the least seconds between two messages of a stream. Waiting messages that newer ones replaced are
    counted as ``thinned`` if there was room, else as ``shed``.
    States go before events, events before streams. Within a rank the message that has waited longest goes first:
    otherwise small ones would always take the room that a large one needs. So that none waits for ever, a stream that
    has waited for OVERDUE_S goes with the states, and an event that has waited so long goes before them.
    """

    def __init__(self, takes: Callable[[Rank, int], bool], counters: Counters, clock: Callable[[], float]) -> None:
        self.stream_s = 0.0
        self._takes, self._counters, self._clock = takes, counters, clock
        self._waiting: dict[str, Waiting] = {}  # by topic, in the order in which they began to wait
        self._sent_at: dict[str, float] = {}  # by the topic of a stream, the oldest first
        self._ranks_that_wait: set[Rank] = set()  # those with a message that found no room
        self._event_waits_since = inf  # when `takes_event` first refused the event that waits; inf: none waits
        #: `takes_event` refused one since the last ``due(Rank.STATE)``: an overdue event still waits before the states.
        self._event_was_refused = False

    def __len__(self) -> int:
        return len(self._waiting)

    def takes_event(self, message: Message) -> bool:
        """Return True if an event may be sent now, with as much room as a state may use.

        False: it stays in its buffer, and its waiting time is noted.
        """
        goes_before_states = self._event_is_overdue or Rank.STATE not in self._ranks_that_wait
        if goes_before_states and self._takes(Rank.STATE, _size(message)):
            self._event_waits_since = inf
            return True
        self._event_waits_since = min(self._event_waits_since, self._clock())
        self._event_was_refused = True
        return False

    def keeps(self, subject: Subject, message: Message, forward: Forward) -> bool:
        """True if the sieve takes ``message``: to send it later, or to drop it for lack of room. False: send it now."""
        rank, topic = rank_of(subject, message), message.topic
        if rank is None:
            return False
        older = self._waiting.get(topic)
        if older is not None:
            has_room = self._takes(rank, 0)  # for nothing: this only asks
            self._counters.add("thinned" if has_room else "shed")
            self._waiting[topic] = Waiting(rank, subject, message, forward, older.since)
            return True
        if self._is_turn(rank, topic) and self._passes(rank, message):
            self._note(rank, topic)
            return False
        if len(self._waiting) < TOPICS:
            self._waiting[topic] = Waiting(rank, subject, message, forward, self._clock())
            return True
        if rank is Rank.STATE:
            return False  # no state is lost
        self._counters.add("shed")
        return True

    def due(self, rank: Rank) -> Iterator[Waiting]:
        """Yield the waiting messages of this rank that may be sent now. States wait while an event is overdue."""
        if rank is Rank.STATE and self._event_is_overdue:
            if self._event_was_refused:  # takes_event had no room for it: it still waits, and states wait behind it
                self._event_was_refused = False
                self._ranks_that_wait.add(rank)
                return
            self._event_waits_since = inf  # none waits: it would have been tried since the last call, and refused
        self._ranks_that_wait.discard(rank)
        overdue_since = self._clock() - OVERDUE_S
        for topic, entry in list(self._waiting.items()):
            present_rank = Rank.STATE if entry.since <= overdue_since else entry.rank
            if present_rank is not rank or not self._is_turn(entry.rank, topic):
                continue
            if not self._passes(rank, entry.message):
                return
            self._note(entry.rank, topic)
            del self._waiting[topic]
            yield entry

    def take_all(self) -> Iterator[Waiting]:
        """Yield all waiting messages, because from now on there is room for all."""
        self._ranks_that_wait.clear()
        while self._waiting:
            yield self._waiting.pop(next(iter(self._waiting)))

    @property
    def _event_is_overdue(self) -> bool:
        return self._clock() - self._event_waits_since >= OVERDUE_S

    def _is_turn(self, rank: Rank, topic: str) -> bool:
        """True if the stream may send again."""
        return rank is Rank.STATE or self._clock() - self._sent_at.get(topic, -inf) >= self.stream_s

    def _passes(self, rank: Rank, message: Message) -> bool:
        """True if there is room for the message, and no other message of its rank waits."""
        if rank in self._ranks_that_wait or not self._takes(rank, _size(message)):
            self._ranks_that_wait.add(rank)
            return False
        return True

    def _note(self, rank: Rank, topic: str) -> None:
        """Note that a message was sent, which sets the time of its stream's next one."""
        if rank is not Rank.STREAM:
            return
        self._sent_at.pop(topic, None)
        if len(self._sent_at) >= TOPICS:
            del self._sent_at[next(iter(self._sent_at))]
        self._sent_at[topic] = self._clock()


def _size(message: Message) -> int:
    return len(message.topic) + len(message.payload)


def rank_of(subject: Subject, message: Message) -> Rank | None:
    """Return the rank in which a message waits; None if it never waits."""
    if subject.kind is Kind.STREAM or (subject.kind is Kind.EVENT and message.qos is QoS.LATEST):
        return Rank.STREAM
    return Rank.STATE if subject.kind is Kind.STATE else None
