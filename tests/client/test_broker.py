"""Messages on their way to the event loop: in order, in parts, and no more than fit."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from pebble.client import arrived
from pebble.client.arrived import Arrived
from pebble.client.broker import Broker
from pebble.transports import Message, QoS
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.web.media.robots import broker_on, until


def message(topic: str, size: int = 1) -> Message:
    return Message(topic, bytes(size))


def ignore(_message: Message, _at: float) -> None:
    pass


def test_messages_stay_in_order_whatever_is_deferred() -> None:
    waiting = Arrived()
    for number in range(6):
        assert waiting.put(ignore, message(str(number)), float(number), deferred=number % 2 == 0)
    taken = [waiting.get() for _ in range(7)]
    assert [(one[1].topic, one[2]) for one in taken if one] == [(str(number), number) for number in range(6)]
    assert taken[6] is None


def test_deferred_messages_leave_room_for_the_others(caplog: pytest.LogCaptureFixture) -> None:
    waiting = Arrived()
    flood = [waiting.put(ignore, message("beat"), 0.0, deferred=True) for _ in range(arrived.MAX_MESSAGES)]
    assert sum(flood) == arrived.MAX_DEFERRED
    others = [waiting.put(ignore, message("state"), 0.0) for _ in range(arrived.MAX_MESSAGES)]
    assert sum(others) == arrived.MAX_MESSAGES - arrived.MAX_DEFERRED
    assert waiting.dropped == arrived.MAX_MESSAGES
    assert 0 < len(caplog.records) < 20
    assert waiting.get()
    assert waiting.put(ignore, message("state"), 0.0)


def test_bytes_are_bounded_and_given_back() -> None:
    waiting, half = Arrived(), arrived.MAX_BYTES // 2
    assert waiting.put(ignore, message("a", half), 0.0)
    assert waiting.put(ignore, message("b", half), 0.0)
    assert not waiting.put(ignore, message("c"), 0.0)
    assert waiting.get()
    assert waiting.put(ignore, message("c"), 0.0)


@asynccontextmanager
async def receiving(handler: arrived.Handler) -> AsyncIterator[tuple[Broker, MemoryTransport]]:
    """A connection that receives everything, and another one that publishes."""
    hub = MemoryHub()
    broker = broker_on(hub)
    await broker.open()
    await broker.subscribe("#", handler)
    with MemoryTransport("operator", hub) as operator:
        yield broker, operator
    await broker.close()


async def _flood() -> tuple[list[str], int, int]:
    taken: list[str] = []
    turns = 0

    def slow(one: Message, _at: float) -> None:
        end = time.monotonic() + 0.001
        while time.monotonic() < end:
            pass
        taken.append(one.topic)

    async with receiving(slow) as (broker, operator):
        for number in range(200):
            operator.publish(f"a/{number}", b"1", qos=QoS.DELIVERED)
        while len(taken) < 200:
            await asyncio.sleep(0)
            turns += 1
    return taken, turns, broker.dropped


def test_a_flood_leaves_the_loop_its_turns() -> None:
    taken, turns, dropped = asyncio.run(_flood())
    assert taken == [f"a/{number}" for number in range(200)]
    assert turns >= 5  # 200 ms of work, in parts of 10 ms
    assert dropped == 0


async def _failing() -> list[str]:
    taken: list[str] = []

    def take(one: Message, _at: float) -> None:
        if one.topic == "a/bad":
            raise ValueError(one.topic)
        taken.append(one.topic)

    async with receiving(take) as (_, operator):
        for topic in ("a/1", "a/bad", "a/2"):
            operator.publish(topic, b"1", qos=QoS.DELIVERED)
        await until(lambda: len(taken) == 2)
    return taken


def test_a_handler_that_fails_holds_back_nothing(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.ERROR):
        assert asyncio.run(_failing()) == ["a/1", "a/2"]
    assert "a message on a/bad" in caplog.text
