"""What every kind of transport inherits and the shared suite does not reach: bounds."""

from __future__ import annotations

from pebble.transports import QoS
from pebble.transports.base import _OWN_LIMIT
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.support import until


def test_retained_topics_are_bounded_in_number() -> None:
    """A bridge retains all flags it forwards; those it knew first are sent again after an outage."""
    hub = MemoryHub()
    with MemoryTransport("bridge", hub) as bridge, MemoryTransport("late", hub) as late:
        received: set[str] = set()
        for number in range(_OWN_LIMIT + 50):
            assert bridge.publish(f"flag{number}", b"1", qos=QoS.DELIVERED, retain=True)
        assert bridge.counters["forgotten"] == 50
        hub.stop(forget=True)
        late.subscribe("#", lambda message: received.add(message.topic), limit=2 * _OWN_LIMIT)
        hub.start()
        assert until(lambda: len(received) == _OWN_LIMIT)
        assert "flag0" in received
