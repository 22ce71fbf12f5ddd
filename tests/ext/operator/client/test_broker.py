"""Messages on their way to the event loop: in order, in parts, and no more than fit."""

from __future__ import annotations

import asyncio
import time

import pytest

from pebble.extensions.operator.client.broker import MAX_BYTES, MAX_MESSAGES, Arrived
from pebble.transports import Message, QoS
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.ext.page.media.robots import broker_on


def message(topic: str, size: int = 1) -> Message:
    return Message(topic, bytes(size))


def ignore(_message: Message, _at: float) -> None:
    pass


def test_messages_stay_in_order_and_are_bounded(caplog: pytest.LogCaptureFixture) -> None:
    waiting = Arrived()
    for number in range(MAX_MESSAGES + 100):
        waiting.put(ignore, message(str(number)), float(number))
    assert waiting.dropped == 100
    assert 0 < len(caplog.records) < 10
    taken = [waiting.get() for _ in range(MAX_MESSAGES + 1)]
    assert [(one[1].topic, one[2]) for one in taken if one] == [(str(number), number) for number in range(MAX_MESSAGES)]
    assert taken[-1] is None


def test_bytes_are_bounded_and_given_back() -> None:
    waiting, half = Arrived(), MAX_BYTES // 2
    for topic, size in (("a", half), ("b", half), ("c", 1)):
        waiting.put(ignore, message(topic, size), 0.0)
    assert waiting.dropped == 1
    assert waiting.get()
    waiting.put(ignore, message("c"), 0.0)
    assert waiting.dropped == 1


async def _flood() -> tuple[list[str], int, int]:
    """Publish 200 messages to a slow handler that fails for the third."""
    taken: list[str] = []
    turns = 0

    def slow(one: Message, _at: float) -> None:
        end = time.monotonic() + 0.001
        while time.monotonic() < end:
            pass
        taken.append(one.topic)
        if one.topic == "a/2":
            raise ValueError(one.topic)

    hub = MemoryHub()
    broker = broker_on(hub)
    await broker.open()
    await broker.subscribe("#", slow)
    with MemoryTransport("operator", hub) as operator:
        for number in range(200):
            operator.publish(f"a/{number}", b"1", qos=QoS.DELIVERED)
        while len(taken) < 200:
            await asyncio.sleep(0)
            turns += 1
    await broker.close()
    return taken, turns, broker.dropped


def test_a_flood_leaves_the_loop_its_turns_and_a_handler_that_fails_holds_back_nothing(
    caplog: pytest.LogCaptureFixture,
) -> None:
    taken, turns, dropped = asyncio.run(_flood())
    assert taken == [f"a/{number}" for number in range(200)]
    assert turns >= 5  # 200 ms of work, in parts of 10 ms
    assert dropped == 0
    assert "a message on a/2" in caplog.text
