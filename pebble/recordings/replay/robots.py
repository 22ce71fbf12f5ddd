"""The connections of a replay: one for each robot, with its will, and one that listens for robots of the same name."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from typing import Final

from pebble.contract import ONLINE, codec
from pebble.contract.payloads import Heartbeat
from pebble.errors import TransportError
from pebble.recordings.replay.live import LiveRobots, base_of_topic
from pebble.recordings.replay.rules import ReplayError, is_zero
from pebble.transports import Message, QoS, State, Transport

OPEN_S: Final = 3.0
CLEAR_S: Final = 5.0  # for a connection that is lost at the end, while topics are still retained
_TICK_S: Final = 0.05
_MORE: Final = 3  # topics named in an error
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
        self._live = LiveRobots(self._bases, now)
        self._retained: dict[str, None] = {}  # topics that hold a message of ours
        self._stack = ExitStack()

    def __enter__(self) -> ReplayedRobots:
        """Connect and listen. Raises TransportError, and ReplayError if one of the robots is live."""
        with ExitStack() as stack:
            stack.callback(self._end)
            self._listen()
            for base in self._bases:
                self._robots[base] = self._opened(base, self._offline(base))
            self._live.connected()
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

    @property
    def live(self) -> str:
        """A robot of a replayed name that has appeared; empty while there is none."""
        return self._live.found

    def check(self) -> None:
        """Raise ReplayError once a robot of a replayed name is live, or if that cannot be noticed."""
        self._live.check()

    def publish(self, message: Message) -> bool:
        """Publish in the name of the robot in the topic; False while that is not possible."""
        if not is_zero(message):
            self.check()
        transport = self._robots[base_of_topic(message.topic)]
        if not self._ready(transport):
            return False
        self._live.note(message)
        retain = message.retain and message.topic not in self._live.taken
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
        listening = self._live.listening
        self.problem = "connected again, listening for the robots" if listening else ""
        return not listening

    def _on_state(self, state: State) -> None:
        if state is State.CONNECTING:
            self._live.lost()

    def _opened(self, name: str, will: Message | None) -> Transport:
        transport = self._make(f"{name}-replay", will)
        transport.on_state(self._on_state)
        transport.open(OPEN_S)
        self._robots[name] = transport  # so that it is closed in any case
        if transport.state is not State.CONNECTED:
            raise TransportError(f"cannot connect: {transport.problem or f'no answer within {OPEN_S:g} s'}")
        return transport

    def _listen(self) -> None:
        listener = self._listener = self._make("replay-listener", None)
        listener.on_state(self._on_state)
        listener.open(OPEN_S)
        if listener.state is not State.CONNECTED:
            raise TransportError(f"cannot connect: {listener.problem or f'no answer within {OPEN_S:g} s'}")
        self._live.listen(listener, self._wait)

    def _clear(self) -> list[str]:
        """Remove what is retained; returns what could not be removed."""
        end = self._now() + CLEAR_S
        live = self._live.found  # what is retained there is now its own
        topics = [topic for topic in self._retained if base_of_topic(topic) != live]
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
        transport = self._robots[base_of_topic(topic)]
        return transport.publish(topic, b"", qos=QoS.DELIVERED, retain=True, remember=False)

    def _end(self) -> None:
        for base, transport in self._robots.items():
            # Closing publishes the will, now with the right time. A live robot has its own.
            transport.will = None if base == self._live.found else self._offline(base)
            with suppress(TransportError):
                transport.close()
        if self._listener is not None:
            self._listener.close()

    def _offline(self, base: str) -> Message:
        payload = codec.encode(ONLINE, Heartbeat(t=self._wall_ms(), online=False))
        return Message(ONLINE.topic(base), payload, QoS.DELIVERED)
