"""What every kind of transport inherits and the shared suite does not reach: bounds."""

from __future__ import annotations

from pebble.transports import QoS
from pebble.transports.base import _OWN_LIMIT
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.support import until


def test_kept_topics_that_strangers_invent_take_no_memory_for_ever() -> None:
    """A bridge keeps whatever flags it forwards; those it knew first are said again after an outage."""
    hub = MemoryHub()
    with MemoryTransport("bridge", hub) as bridge, MemoryTransport("late", hub) as late:
        heard: set[str] = set()
        for number in range(_OWN_LIMIT + 50):
            assert bridge.publish(f"flag{number}", b"1", qos=QoS.DELIVERED, retain=True)
        assert bridge.counters["forgotten"] == 50
        hub.stop(forget=True)
        late.subscribe("#", lambda message: heard.add(message.topic), limit=2 * _OWN_LIMIT)
        hub.start()
        assert until(lambda: len(heard) == _OWN_LIMIT)
        assert "flag0" in heard
