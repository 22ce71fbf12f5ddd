"""Messages on their way to the event loop: in order, in parts, and no more than fit."""

from __future__ import annotations

import asyncio
import logging
import time

import pytest

from pebble.client import arrived
from pebble.client.arrived import Arrived
from pebble.client.broker import Broker
from pebble.transports import Message, MqttSettings


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


class Fed(Broker):
    """A broker whose messages come from a test."""

    def __init__(self) -> None:
        super().__init__(MqttSettings(host="127.0.0.1"))
        self._loop = asyncio.get_running_loop()

    def feed(self, handler: arrived.Handler, topic: str) -> None:
        self._arrived.put(handler, message(topic), 0.0)
        self._wake()


async def _flood() -> tuple[list[str], int, int]:
    broker, taken, turns = Fed(), [], 0

    def slow(one: Message, _at: float) -> None:
        end = time.monotonic() + 0.001
        while time.monotonic() < end:
            pass
        taken.append(one.topic)

    for number in range(200):
        broker.feed(slow, str(number))
    while len(taken) < 200:
        await asyncio.sleep(0)
        turns += 1
    return taken, turns, broker._arrived.dropped


def test_a_flood_leaves_the_loop_its_turns() -> None:
    taken, turns, dropped = asyncio.run(_flood())
    assert taken == [str(number) for number in range(200)]
    assert turns >= 5  # 200 ms of work, in parts of 10 ms
    assert dropped == 0


async def _failing() -> list[str]:
    broker, taken = Fed(), []

    def take(one: Message, _at: float) -> None:
        if one.topic == "bad":
            raise ValueError(one.topic)
        taken.append(one.topic)

    for topic in ("a", "bad", "b"):
        broker.feed(take, topic)
    await asyncio.sleep(0.01)
    return taken


def test_a_handler_that_fails_holds_back_nothing(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.ERROR):
        assert asyncio.run(_failing()) == ["a", "b"]
    assert "a message on bad" in caplog.text
