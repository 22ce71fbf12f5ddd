"""Finds retained messages at the remote broker that the robot has removed while no bridge was running.

An earlier bridge process had forwarded them, so only the broker has them. Each bridge process looks once, and only for
topics on which only the robot publishes.
"""

from collections.abc import Callable

from pebble.contract import CHANNELS, MCU_DESCRIBE, MCU_VALUE, ONLINE, OUTGOING, Channel, Kind
from pebble.forwarding.subjects import Subjects
from pebble.transports import Message, Subscription, Transport

_TOPICS = 10_000  # noted of each side; with more nothing is removed
_EXCEPTED = (ONLINE, MCU_DESCRIBE)  # the bridge's own, and one that MCU_VALUE covers


class Leftovers:
    """The topics that robot and broker retain. Transports call :meth:`note_local` on their threads."""

    def __init__(self, base: str, subjects: Subjects, remote: Transport, *channels: Channel) -> None:
        """Store the arguments; ``channels`` are more channels that the bridge itself publishes on the remote side."""
        self._remote = remote
        self._on_robot: set[str] | None = set()  # topics that the robot retains; None: the search is over
        self._at_remote: set[str] = set()  # topics that the broker retains
        self._subscriptions: list[Subscription] = []
        states = [channel for channel in CHANNELS if channel.kind is Kind.STATE and channel.direction == OUTGOING]
        wanted = [state for state in states if state not in (*_EXCEPTED, *channels) and state.synonym_of is None]
        patterns = [state.filter(base) for state in wanted if state.is_pattern]
        named = subjects.topics(*(state for state in wanted if not state.is_pattern))
        self._filters = [MCU_VALUE.filter(base), *patterns, *named]  # MCU_VALUE: a manifest may retain it
        self._next = 0  # the index of the filter to ask for next

    @property
    def done(self) -> bool:
        return self._on_robot is None

    def note_local(self, message: Message) -> None:
        on_robot = self._on_robot
        if message.payload and on_robot is not None and len(on_robot) <= _TOPICS:
            on_robot.add(message.topic)

    def begin(self) -> None:
        """Start again, because a connection was lost."""
        self._close()
        self._next = 0
        self._at_remote.clear()

    def ask_next(self) -> bool:
        """Ask the broker for the topics of the next filter, and wait for the answer; False if none is left.

        Topics that the robot has are left out: they stay, and over a thin link the answers would delay messages to it.
        """
        on_robot = self._on_robot or set()
        while self._next < len(self._filters) and self._filters[self._next] in on_robot:
            self._next += 1
        if self._next == len(self._filters):
            return False
        filter_ = self._filters[self._next]
        self._next += 1
        subscription = self._remote.subscribe(filter_, self._note_remote, echo=False, direct=True)
        self._subscriptions.append(subscription)
        if subscription.refused:  # it will refuse the others as well
            self._next = len(self._filters)
        return True

    def remove(self, remove_topic: Callable[..., bool]) -> list[str]:
        """Remove messages that only the broker retains; return their topics. Nothing is noted afterwards.

        ``remove_topic(topic, unless=stays)`` removes a message unless ``stays(topic)``, and returns True if it did.
        """
        self._close()
        removed = [topic for topic in sorted(self._at_remote) if remove_topic(topic, unless=self._stays)]
        self._on_robot = None
        return removed

    def _stays(self, topic: str) -> bool:
        on_robot = self._on_robot or set()
        return topic in on_robot or max(len(on_robot), len(self._at_remote)) > _TOPICS

    def _close(self) -> None:
        while self._subscriptions:
            self._subscriptions.pop().close()

    def _note_remote(self, message: Message) -> None:
        if message.retain and message.payload and len(self._at_remote) <= _TOPICS:
            self._at_remote.add(message.topic)
