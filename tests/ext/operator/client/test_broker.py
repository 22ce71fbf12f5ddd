"""Messages on their way to the event loop: in order, in parts, and no more than fit."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from pebble.extensions.operator.client.broker import MAX_BYTES, MAX_MESSAGES, Arrived, Broker, Handler
from pebble.transports import Message, QoS
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.ext.page.media.robots import broker_on, until


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


@asynccontextmanager
async def receiving(handler: Handler) -> AsyncIterator[tuple[Broker, MemoryTransport]]:
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
