"""What every kind of transport inherits and the shared suite does not reach: bounds."""

from __future__ import annotations

import threading
import tracemalloc

import pytest

from pebble.transports import Message, QoS, base, own_retained
from pebble.transports.base import Subscriptions
from pebble.transports.memory import MemoryHub, MemoryTransport
from pebble.transports.topics import check_topic
from pebble.transports.zenoh.keymap import key_to_topic, topic_to_key
from tests.support import until


def test_retained_topics_are_bounded_in_number() -> None:
    """A bridge retains all flags it forwards; those it knew first are sent again after an outage."""
    hub = MemoryHub()
    with MemoryTransport("bridge", hub) as bridge, MemoryTransport("late", hub) as late:
        received: set[str] = set()
        for number in range(own_retained.LIMIT + 50):
            assert bridge.publish(f"flag{number}", b"1", qos=QoS.DELIVERED, retain=True)
        assert bridge.counters["forgotten"] == 50
        hub.stop(forget=True)
        late.subscribe("#", lambda message: received.add(message.topic), limit=2 * own_retained.LIMIT)
        hub.start()
        assert until(lambda: len(received) == own_retained.LIMIT)
        assert "flag0" in received


def test_retained_messages_are_bounded_in_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    """An older value is not sent again in place of a newer one that is too large to be stored."""
    monkeypatch.setattr(own_retained, "BYTES", 1000)
    hub = MemoryHub()
    with MemoryTransport("bridge", hub) as bridge, MemoryTransport("late", hub) as late:
        for topic, size in (("a", 400), ("b", 400), ("c", 400), ("a", 900), ("d", 500)):
            assert bridge.publish(topic, bytes(size), qos=QoS.DELIVERED, retain=True)
        assert bridge.counters["forgotten"] == 2
        hub.stop(forget=True)
        assert not bridge.publish("e", bytes(400), qos=QoS.DELIVERED, retain=True)
        assert (bridge.counters["forgotten"], bridge.counters["refused"]) == (3, 1)
        received: dict[str, int] = {}
        late.subscribe("#", lambda message: received.update({message.topic: len(message.payload)}))
        hub.start()
        assert until(lambda: received == {"b": 400, "d": 500})


def test_a_slow_handlers_queue_is_bounded_in_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(base, "QUEUE_BYTES", 1000)
    goes_on, received = threading.Event(), list[int]()

    def handle(message: Message) -> None:
        goes_on.wait(10)
        received.append(message.payload[0])

    with MemoryTransport("client", MemoryHub()) as client:
        slow = client.subscribe("#", handle)
        client.publish("t", bytes([0]), qos=QoS.DELIVERED)
        assert until(lambda: client.counters["delivered"] == 1)
        for number in range(1, 10):
            client.publish("t", bytes([number]) * 300, qos=QoS.DELIVERED)
        assert until(lambda: slow.dropped == 6)
        goes_on.set()
        assert until(lambda: received == [0, 7, 8, 9])
        assert slow.dropped == client.counters["dropped"] == 6


def test_long_topics_of_strangers_are_not_remembered() -> None:
    with MemoryTransport("client", MemoryHub()) as client:
        subscriptions, wanted = Subscriptions(), client.subscribe("a/#", lambda _: None)
        subscriptions.add(wanted)
        tracemalloc.start()
        for number in range(1000):
            assert subscriptions.matching(f"a/{number:60000}") == (wanted,)
            assert key_to_topic(topic_to_key(check_topic(f"a/{number:1000}"))) == f"a/{number:1000}"
        left, _ = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert left < 500_000
