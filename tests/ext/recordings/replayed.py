"""A recording as the robot that a service under test receives."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from pebble.extensions.recordings.library import merged
from pebble.transports import Message, QoS, Transport
from pebble.transports.memory import MemoryHub, MemoryTransport
from pebble.transports.topics import matches
from tests.support import until

Plays = Callable[..., int]


@pytest.fixture
def recording() -> Iterator[Plays]:
    """``recording(path, hub)`` publishes a recording to the clients of a hub, and returns when they have received all.

    It takes no time: of 60 s only as long as the clients need. A filter of topics may follow.
    """
    transports: list[Transport] = []

    def play(path: Path, hub: MemoryHub, filter_: str = "#") -> int:
        transport = MemoryTransport("recording", hub).open()
        transports.append(transport)
        count = 0
        for one in merged([path]):
            if matches(filter_, one.channel.topic):
                flags = one.channel.metadata
                message = Message(one.channel.topic, one.payload, QoS(int(flags["qos"])), flags.get("retain") == "1")
                transport.publish(message.topic, message.payload, qos=message.qos, retain=message.retain)
                count += 1
                assert until(lambda: not any(client._inbox for client in hub._connected_clients), step=0.0001)
        return count

    yield play
    for transport in transports:
        transport.close()
