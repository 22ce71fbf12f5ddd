"""Messages on their way to the event loop, and lines to a terminal: in order, in parts, and no more than fit."""

from __future__ import annotations

import asyncio
import threading
import time

import pytest

from pebble.extensions.operator import notices
from pebble.extensions.operator.client.broker import MAX_BYTES, MAX_MESSAGES, Arrived
from pebble.extensions.operator.notices import PrintingThread
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


def test_a_flood_leaves_the_loop_its_turns_and_a_handler_that_fails_holds_back_nothing(
    caplog: pytest.LogCaptureFixture,
) -> None:
    taken: list[str] = []
    hub = MemoryHub()
    broker = broker_on(hub)

    def slow(one: Message, _at: float) -> None:
        end = time.monotonic() + 0.001
        while time.monotonic() < end:
            pass
        taken.append(one.topic)
        if one.topic == "a/2":
            raise ValueError(one.topic)

    async def flood() -> int:
        """Publish 200 messages to the handler; return how often the loop had a turn meanwhile."""
        turns = 0
        await broker.open()
        await broker.subscribe("#", slow)
        with MemoryTransport("operator", hub) as operator:
            for number in range(200):
                operator.publish(f"a/{number}", b"1", qos=QoS.DELIVERED)
            while len(taken) < 200:
                await asyncio.sleep(0)
                turns += 1
        await broker.close()
        return turns

    assert asyncio.run(flood()) >= 5  # 200 ms of work, in parts of 10 ms
    assert taken == [f"a/{number}" for number in range(200)]
    assert broker.dropped == 0
    assert "a message on a/2" in caplog.text


def test_lines_are_printed_in_turn_also_after_an_error_and_hold_up_nothing() -> None:
    printing, printed, goes_on = PrintingThread(), list[str](), threading.Event()
    for prints in (goes_on.wait, lambda: printed[0], lambda: printed.append("a"), lambda: printed.append("b")):
        printing.run(prints)
    printing.close(0.01)
    assert not printed
    goes_on.set()
    printing.close()
    assert printed == ["a", "b"]


def test_lines_are_bounded_and_what_was_dropped_is_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(notices, "_MOST", 2)
    printing, printed, goes_on = PrintingThread(), list[int](), threading.Event()
    printing.run(goes_on.wait)
    for number in range(9):
        printing.run(lambda number=number: printed.append(number))
    goes_on.set()
    printing.close()
    assert printed == list(range(len(printed)))
    assert capsys.readouterr().err == f"pebble: lines that were not printed, as too many waited: {9 - len(printed)}\n"
