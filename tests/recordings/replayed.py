"""A recording as the robot that a service under test receives."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from pebble.recordings.replay.player import Player
from pebble.recordings.replay.rules import Options, Rules
from pebble.recordings.replay.source import ReplaySource
from pebble.transports import Message, Transport
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.recordings.playing import VirtualTime
from tests.support import until

#: Everything as it was: in a hub of its own a replay moves no robot.
AS_RECORDED = Options(system=None, incoming=True, actions=True, retain=True, shift=False)

Plays = Callable[..., Player]


@pytest.fixture
def recording() -> Iterator[Plays]:
    """``recording(paths, hub)`` publishes recordings to the clients of a hub, and returns when they have received all.

    It takes no time: of 60 s only as long as the clients need. ``options`` and the keywords of `Player` may follow.
    """
    transports: list[Transport] = []

    def play(paths: list[Path], hub: MemoryHub, options: Options = AS_RECORDED, **playing: float | bool) -> Player:
        time, source = VirtualTime(), ReplaySource(paths)
        rules = Rules(options, source.channels)
        transport = MemoryTransport("recording", hub).open()
        transports.append(transport)

        def publish(message: Message) -> bool:
            accepted = transport.publish(message.topic, message.payload, qos=message.qos, retain=message.retain)
            assert until(lambda: not any(client._inbox for client in hub._connected_clients), step=0.0001)
            return accepted

        clocks = {"now": time.now, "wall_ns": time.wall_ns, "wait": time.wait}
        player = Player(source, rules, publish, **clocks, **playing)  # type: ignore[arg-type]
        player.run()
        return player

    yield play
    for transport in transports:
        transport.close()
