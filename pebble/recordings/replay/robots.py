"""The connections of a replay: one for each robot, with its will, and one that listens for robots of the same name."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from typing import Final

from pebble.contract import CAPABILITIES, HEARTBEAT, ONLINE, OUTGOING, STATUS, codec
from pebble.contract.identity import parse_topic
from pebble.contract.payloads import Heartbeat
from pebble.errors import PayloadError, TransportError
from pebble.recordings.replay.rules import ReplayError, is_zero
from pebble.transports import Message, QoS, State, Transport

LISTEN_S: Final = 2.0  # eight heartbeats of a robot
_OPEN_S: Final = 3.0
_RETURN_S: Final = 5.0  # for the first own message
_CLEAR_S: Final = 5.0  # for a connection that is lost at the end, while topics are still retained
_TICK_S: Final = 0.05
_OWN: Final = 4096  # own messages that may still come back
_MORE: Final = 3  # topics named in an error
#: What a robot publishes that is running, wherever its connection leads.
_SIGNS: Final = (ONLINE, HEARTBEAT, STATUS, CAPABILITIES)
_SUFFIXES: Final = tuple(channel.suffix for channel in _SIGNS)
_HEARTBEATS: Final = (ONLINE.suffix, HEARTBEAT.suffix)

#: Makes a transport that is not opened yet, from a name and a will.
Make = Callable[[str, Message | None], Transport]


class ReplayedRobots:
    """Publishes in the name of robots that are not there, as long as none of them is.

    ``now`` in seconds, ``wall_ms`` since 1970, ``wait`` waits for so many seconds.
    """

    def __init__(
        self,
        make: Make,
        bases: Iterable[str],
        *,
        now: Callable[[], float],
        wall_ms: Callable[[], int],
        wait: Callable[[float], None],
    ) -> None:
        self.problem = ""  # why nothing is published now
        self._make, self._bases = make, list(bases)
        self._now, self._wall_ms, self._wait = now, wall_ms, wait
        self._robots: dict[str, Transport] = {}
        self._listener: Transport | None = None
        self._live = ""  # a robot of that name that has appeared
        self._own: OrderedDict[tuple[str, bytes], None] = OrderedDict()
        self._awaited: dict[str, float] = {}  # robots none of whose messages has come back, and since when
        self._returned: set[str] = set()
        self._retained: dict[str, None] = {}  # topics that hold a message of ours
        self._taken: set[str] = set()  # topics that held one before
        self._quiet_at: float | None = None  # when listening again after an outage is over
        self._stack = ExitStack()

    def __enter__(self) -> ReplayedRobots:
        """Connect and listen. Raises TransportError, and ReplayError if one of the robots is live."""
        with ExitStack() as stack:
            stack.callback(self._end)
            self._listen()
            for base in self._bases:
                self._robots[base] = self._opened(base, self._offline(base))
            self._quiet_at = None
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_error: object) -> None:
        """Remove what is retained, publish that the robots are offline, and disconnect. Raises ReplayError."""
        with self._stack:
            left = self._clear()
        if left:
            more = f" and {len(left) - _MORE} more" if len(left) > _MORE else ""
            raise ReplayError(
                f"still retained, because the connection is lost: {', '.join(left[:_MORE])}{more}. "
                "Remove each: pebble topic pub TOPIC '' --retain"
            )

    def check(self) -> None:
        """Raise ReplayError once a robot of a replayed name is live, or if that cannot be noticed."""
        if self._live:
            raise ReplayError(f"{self._live} is live: the replay has ended, so that it is not mistaken for the robot")
        for base, since in list(self._awaited.items()):
            if self._now() - since > _RETURN_S and base not in self._returned:
                raise ReplayError(
                    f"the broker does not deliver {base}/{OUTGOING}/# to this login, or not from it: a live robot "
                    "would not be noticed"
                )

    def publish(self, message: Message) -> bool:
        """Publish in the name of the robot in the topic; False while that is not possible."""
        if not is_zero(message):
            self.check()
        transport = self._robots[_base(message.topic)]
        if not self._ready(transport):
            return False
        self._note(message)
        retain = message.retain and message.topic not in self._taken
        if not transport.publish(
            message.topic, message.payload, qos=message.qos, retain=retain, remember=False, urgent=False
        ):
            return False
        if retain and message.payload:
            self._retained[message.topic] = None
        elif retain:
            self._retained.pop(message.topic, None)
        return True

    def _ready(self, transport: Transport) -> bool:
        """Whether it is connected; after an outage, once it is known that no robot has come meanwhile."""
        for one in (transport, self._listener):
            if one is None or one.state is not State.CONNECTED:
                self.problem = f"no connection: {(one and one.problem) or 'it was lost'}"
                return False
        if self._quiet_at is None:
            return True
        self._quiet_at = min(self._quiet_at, self._now() + LISTEN_S)
        self.problem = "connected again, listening for the robots"
        if self._now() < self._quiet_at:
            return False
        self._quiet_at, self.problem = None, ""
        return True

    def _on_state(self, state: State) -> None:
        """However short an outage is, a robot may have come meanwhile."""
        if state is State.CONNECTING:
            self._quiet_at = float("inf")
            self._awaited.clear()

    def _note(self, message: Message) -> None:
        """Remember a message that will come back, before it is published."""
        if message.topic.endswith(_SUFFIXES):
            self._own[message.topic, message.payload] = None
            if _base(message.topic) not in self._returned:
                self._awaited.setdefault(_base(message.topic), self._now())
            if len(self._own) > _OWN:
                self._own.popitem(last=False)

    def _opened(self, name: str, will: Message | None) -> Transport:
        transport = self._make(f"{name}-replay", will)
        transport.on_state(self._on_state)
        transport.open(_OPEN_S)
        self._robots[name] = transport  # so that it is closed in any case
        if transport.state is not State.CONNECTED:
            raise TransportError(f"cannot connect: {transport.problem or f'no answer within {_OPEN_S:g} s'}")
        return transport

    def _listen(self) -> None:
        listener = self._listener = self._make("replay-listener", None)
        listener.on_state(self._on_state)
        listener.open(_OPEN_S)
        if listener.state is not State.CONNECTED:
            raise TransportError(f"cannot connect: {listener.problem or f'no answer within {_OPEN_S:g} s'}")
        signs = [listener.subscribe(c.topic(base), self._on_sign) for base in self._bases for c in _SIGNS]
        # At QoS 1 a broker sends no more than some 1,000 retained messages.
        everything = [listener.subscribe(f"{base}/{OUTGOING}/#", self._on_any, qos=QoS.LATEST) for base in self._bases]
        if any(subscription.refused for subscription in (*signs, *everything)):
            raise ReplayError(
                "the broker refuses to deliver the topics of these robots: a live one would not be noticed"
            )
        end = self._now() + LISTEN_S
        while self._now() < end and not self._live:
            self._wait(_TICK_S)
        for subscription in everything:
            subscription.close()
        if self._live:
            raise ReplayError(f"{self._live} is live: switch it off, or choose a --base at which there is no robot")

    def _on_any(self, message: Message) -> None:
        if message.retain:
            self._taken.add(message.topic)
        else:
            self._on_sign(message)

    def _on_sign(self, message: Message) -> None:
        """Anything that is neither old, nor removed, nor ours, nor a will means a live robot."""
        if (message.topic, message.payload) in self._own:
            self._returned.add(_base(message.topic))
            return
        if message.retain or not message.payload or _is_offline(message):
            return
        parsed = parse_topic(message.topic)
        if parsed is not None:
            self._live = self._live or parsed.identity.base

    def _clear(self) -> list[str]:
        """Remove what is retained; returns what could not be removed."""
        end = self._now() + _CLEAR_S
        topics = [topic for topic in self._retained if _base(topic) != self._live]  # now the live robot's own
        while topics and self._now() < end:
            topics = [topic for topic in topics if not self._removed(topic)]
            if topics:
                self._wait(_TICK_S)
        while self._retained and self._unconfirmed and self._now() < end:
            self._wait(_TICK_S)
        return topics

    @property
    def _unconfirmed(self) -> bool:
        return any(robot.outgoing.waiting for robot in self._robots.values())

    def _removed(self, topic: str) -> bool:
        transport = self._robots[_base(topic)]
        return transport.publish(topic, b"", qos=QoS.DELIVERED, retain=True, remember=False)

    def _end(self) -> None:
        for base, transport in self._robots.items():
            # Closing publishes the will, now with the right time. A live robot has its own.
            transport.will = None if base == self._live else self._offline(base)
            with suppress(TransportError):
                transport.close()
        if self._listener is not None:
            self._listener.close()

    def _offline(self, base: str) -> Message:
        payload = codec.encode(ONLINE, Heartbeat(t=self._wall_ms(), online=False))
        return Message(ONLINE.topic(base), payload, QoS.DELIVERED)


def _base(topic: str) -> str:
    return "/".join(topic.split("/", 3)[:3])


def _is_offline(message: Message) -> bool:
    if not message.topic.endswith(_HEARTBEATS):
        return False
    try:
        heartbeat: Heartbeat = codec.decode(ONLINE, message.payload)
    except PayloadError:
        return True  # no sign of life of any robot
    return heartbeat.online is False
