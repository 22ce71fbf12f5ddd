"""The connections of a replay: one for each robot, with a will."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Final

from pebble.contract import ONLINE, codec
from pebble.contract.payloads import Heartbeat
from pebble.errors import TransportError
from pebble.transports import Message, QoS, State, Transport

OPEN_S: Final = 3.0
#: Makes a transport that is not opened yet, from a name and a will.
Make = Callable[[str, Message | None], Transport]


class ReplayedRobots:
    """A publisher in the names of robots, which it finally publishes as offline."""

    def __init__(self, make: Make, bases: Iterable[str]) -> None:
        self.problem = ""  # why nothing is published now
        self._make, self._bases = make, list(bases)
        self._robots: dict[str, Transport] = {}

    def __enter__(self) -> ReplayedRobots:
        """Connect. Raises TransportError."""
        try:
            for base in self._bases:
                self._open(base)
        except TransportError:
            self._close()
            raise
        return self

    def __exit__(self, *_error: object) -> None:
        self._close()

    def publish(self, message: Message) -> bool:
        """Publish in the name of the robot in the topic; return False if that is not possible now."""
        transport = self._robots["/".join(message.topic.split("/", 3)[:3])]
        if transport.state is not State.CONNECTED:
            self.problem = f"no connection: {transport.problem or 'it was lost'}"
            return False
        self.problem = ""
        return transport.publish(message.topic, message.payload, qos=message.qos, remember=False, urgent=False)

    def _open(self, base: str) -> None:
        transport = self._robots[base] = self._make(f"{base}-replay", self._offline(base))
        transport.open(OPEN_S)
        if transport.state is not State.CONNECTED:
            raise TransportError(f"cannot connect: {transport.problem or f'no answer within {OPEN_S:g} s'}")

    def _close(self) -> None:
        for base, transport in self._robots.items():
            transport.will = self._offline(base)  # closing publishes it, now with the right time
            with suppress(TransportError):
                transport.close()

    @staticmethod
    def _offline(base: str) -> Message:
        payload = codec.encode(ONLINE, Heartbeat(t=time.time_ns() // 1_000_000, online=False))
        return Message(ONLINE.topic(base), payload, QoS.DELIVERED)
