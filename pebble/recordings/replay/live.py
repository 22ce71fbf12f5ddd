"""Notices a live robot that has the name of a replayed one, among the replay's own messages."""

from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Final

from pebble.contract import CAPABILITIES, HEARTBEAT, LINK, ONLINE, OUTGOING, STATUS, codec
from pebble.contract.identity import parse_topic
from pebble.contract.levels import level_of, silent_after
from pebble.contract.payloads import Heartbeat, LinkLevel
from pebble.errors import PayloadError
from pebble.recordings.replay.rules import ReplayError
from pebble.transports import Message, QoS, Transport

RETURN_S: Final = 5.0  # for the first own message
_TICK_S: Final = 0.05
_OWN: Final = 4096  # own messages that may still come back
#: What a robot publishes that is running, wherever its connection leads.
_SIGNS: Final = (ONLINE, HEARTBEAT, STATUS, CAPABILITIES, LINK)
_SUFFIXES: Final = tuple(channel.suffix for channel in _SIGNS)
_HEARTBEATS: Final = (ONLINE.suffix, HEARTBEAT.suffix)


class LiveRobots:
    """``bases`` are the replayed names, ``now`` is in seconds."""

    def __init__(self, bases: Sequence[str], now: Callable[[], float]) -> None:
        self.found = ""  # a robot of such a name that has appeared
        self.taken: set[str] = set()  # topics that held a message before
        self._bases, self._now = bases, now
        self._own: OrderedDict[tuple[str, bytes], None] = OrderedDict()
        self._awaited: dict[str, float] = {}  # robots none of whose messages has come back, and since when
        self._returned: set[str] = set()
        self._links: dict[str, LinkLevel] = {}  # by topic, as the broker has it of a robot that may be there
        self._back_at: float | None = None  # since when it listens again after an outage; infinite: not yet

    def listen(self, listener: Transport, wait: Callable[[float], None]) -> None:
        """Subscribe, and wait for a sign of life. Raises ReplayError if there is one, or would not be noticed."""
        signs = [listener.subscribe(c.topic(base), self._on_sign) for base in self._bases for c in _SIGNS]
        # At QoS 1 a broker sends no more than some 1,000 retained messages.
        everything = [listener.subscribe(f"{base}/{OUTGOING}/#", self._on_any, qos=QoS.LATEST) for base in self._bases]
        if any(subscription.refused for subscription in (*signs, *everything)):
            raise ReplayError(
                "the broker refuses to deliver the topics of these robots: a live one would not be noticed"
            )
        began = self._now()
        while self._now() - began < self._listen_s and not self.found:
            wait(_TICK_S)
        for subscription in everything:
            subscription.close()
        if self.found:
            raise ReplayError(f"{self.found} is live: switch it off, or choose a --base at which there is no robot")

    def check(self) -> None:
        """Raise ReplayError once a robot of a replayed name is live, or if that cannot be noticed."""
        if self.found:
            raise ReplayError(f"{self.found} is live: the replay has ended, so that it is not mistaken for the robot")
        for base, since in list(self._awaited.items()):
            if self._now() - since > RETURN_S and base not in self._returned:
                raise ReplayError(
                    f"the broker does not deliver {base}/{OUTGOING}/# to this login, or not from it: a live robot "
                    "would not be noticed"
                )

    def note(self, message: Message) -> None:
        """Remember a message that will come back, before it is published."""
        if message.topic.endswith(_SUFFIXES):
            self._own[message.topic, message.payload] = None
            if base_of_topic(message.topic) not in self._returned:
                self._awaited.setdefault(base_of_topic(message.topic), self._now())
            if len(self._own) > _OWN:
                self._own.popitem(last=False)

    def lost(self) -> None:
        """A connection is lost: however short the outage is, a robot may have come meanwhile."""
        self._back_at = float("inf")
        self._awaited.clear()

    def connected(self) -> None:
        """All connections are there for the first time."""
        self._back_at = None

    @property
    def listening(self) -> bool:
        """Whether an outage is so short ago that a robot may have come without being noticed yet."""
        if self._back_at is not None:
            self._back_at = min(self._back_at, self._now())
            if self._now() - self._back_at >= self._listen_s:
                self._back_at = None
        return self._back_at is not None

    @property
    def _listen_s(self) -> float:
        """A live robot would have been heard by then, as far as the broker has what the robot's link carries."""
        return max((silent_after(link=one) for one in self._links.values()), default=silent_after())

    def _on_any(self, message: Message) -> None:
        if message.retain:
            self.taken.add(message.topic)
        else:
            self._on_sign(message)

    def _on_sign(self, message: Message) -> None:
        """Anything that is neither old, nor removed, nor ours, nor a will means a live robot."""
        if (message.topic, message.payload) in self._own:
            self._returned.add(base_of_topic(message.topic))
            return
        if message.retain and message.topic.endswith(LINK.suffix):
            self._links[message.topic] = level_of(message.payload)
        if message.retain or not message.payload or _is_offline(message):
            return
        parsed = parse_topic(message.topic)
        if parsed is not None:
            self.found = self.found or parsed.identity.base


def base_of_topic(topic: str) -> str:
    return "/".join(topic.split("/", 3)[:3])


def _is_offline(message: Message) -> bool:
    if not message.topic.endswith(_HEARTBEATS):
        return False
    try:
        heartbeat: Heartbeat = codec.decode(ONLINE, message.payload)
    except PayloadError:
        return True  # no sign of life of any robot
    return heartbeat.online is False
