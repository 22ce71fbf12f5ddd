"""Asks a broker once which of our own retained messages it has: nothing else shows what it silently drops."""

from collections import deque
from collections.abc import Callable, Collection
from math import inf

from pebble.transports.base import Message, QoS
from pebble.transports.mqtt.connection import Connection
from pebble.transports.mqtt.outgoing import PendingAck

AFTER_S = 2.0  # from the first connection to the question
LATE_S = 1.0  # without another message, after which none comes any more
TOPICS = 200  # at most are asked for
_VALUES = 16  # of a topic, of which each may be the broker's newest


class RetentionCheck:
    """One question to one broker; no I/O: subscribe to `topics`, hand over what comes, and see what is `missing`."""

    def __init__(self, now: float) -> None:
        self.topics: list[str] = []
        self._due_at, self._newest_at = now + AFTER_S, inf
        self._found: set[str] = set()

    def is_due(self, now: float) -> bool:
        return not self.topics and now >= self._due_at

    def begin(self, topics: Collection[str]) -> list[str]:
        """Returns those of ``topics`` to subscribe to."""
        self.topics = list(topics)[:TOPICS]
        return self.topics

    def note(self, messages: list[Message], now: float) -> None:
        found = {one.topic for one in messages if one.retain}.intersection(self.topics)
        if found:
            self._found |= found
            self._newest_at = now

    def refused(self, topic: str) -> None:
        """We may not subscribe to ``topic``: so nothing shows whether the broker has it."""
        self._found.add(topic)

    def missing(self, now: float, *, answered: bool) -> list[str] | None:
        """What the broker has not sent, once the question is over; None before that.

        ``answered`` is whether it has answered a later request: what it has should have come, but may still be late.
        """
        if answered:
            self._newest_at = min(self._newest_at, now)
        left = [topic for topic in self.topics if topic not in self._found]
        return None if left and now - self._newest_at < LATE_S else left


class RetainedProof:
    """Shows by one retained topic which others a broker has kept: its values differ, and only we publish there.

    A broker that has one of the values that may be its newest has all that was sent before it.
    """

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self._values: deque[tuple[bytes, set[str]]] = deque(maxlen=_VALUES)  # and the topics that were sent after each

    def sent(self, message: Message, *, confirmed: bool) -> None:
        """A retained message is sent. ``confirmed``: the broker has the newest value of the topic before."""
        if message.topic != self.topic:
            for _, later in self._values:
                later.add(message.topic)
            return
        while len(self._values) > 1 and confirmed:
            self._values.popleft()
        self._values.append((message.payload, set()))

    @property
    def unproved(self) -> set[str]:
        """Topics that have to be asked for beside this one."""
        return set().union(*(later for _, later in self._values))

    def proves(self, found: bytes) -> bool:
        """Whether a broker that has ``found`` has all that was sent, but for what is `unproved`."""
        return any(value == found for value, _ in self._values)


class RetentionChecks:
    """Asks each broker that a transport connects to, once."""

    def __init__(self) -> None:
        self.current: RetentionCheck | None = None
        self._answer = PendingAck()
        self._address = ""
        self._checked: set[str] = set()  # addresses of brokers that were asked

    def begin(self, address: str, now: float) -> None:
        """There is a new connection, to the broker at ``address``."""
        self._address, self.current = address, None if address in self._checked else RetentionCheck(now)

    def forget(self) -> None:
        """Ask this broker again at the next connection."""
        self._checked.discard(self._address)

    def proceed(self, connection: Connection, now: float, own_topics: Callable[[], list[str]]) -> list[str]:
        """Ask for each of ``own_topics`` by name once it is time; returns those that the broker has not sent."""
        check = self.current
        if check is None:
            return []
        if check.is_due(now):
            if topics := check.begin(own_topics()):
                connection.subscribe([(topic, False) for topic in topics], QoS.LATEST)
                self._answer = connection.ping()
            else:
                self.current = None
            return []
        missing = check.missing(now, answered=self._answer.done) if check.topics else None
        if missing is None:
            return []
        connection.unsubscribe(check.topics)
        self.current = None
        self._checked.add(self._address)
        return missing
