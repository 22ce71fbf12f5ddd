from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from pebble.launcher.news import WORD_LIMIT, News, Word, next_word
from pebble.launcher.reactor import Reactor
from pebble.transports import Message, QoS

WILL = Message("status", b"gone", QoS.DELIVERED, retain=True)


class Line:
    """News, and a listener who reads when asked."""

    def __init__(self) -> None:
        self.reactor = Reactor()
        self.news = News(self.reactor)
        self._listener: int | None = None

    def connect(self) -> None:
        self.hang_up()
        self._listener = self.news.connect(WILL)
        os.set_blocking(self._listener, False)

    def hang_up(self) -> None:
        if self._listener is not None:
            os.close(self._listener)
            self._listener = None

    def next(self) -> Word | None:
        assert self._listener is not None
        return next_word(self._listener)

    def heard(self) -> list[tuple[str, bytes]]:
        """What and payload of every word there is."""
        words = []
        try:
            while (word := self.next()) is not None:
                words.append((word.what, word.message.payload))
        except BlockingIOError:
            pass
        return words

    def fill(self) -> int:
        """Records until one is dropped; returns how many there was room for."""
        count = 0
        while not self.news.dropped:
            self.news.record(Message("logs", b"x" * 500))
            count += 1
        return count - 1

    def close(self) -> None:
        self.news.close()
        self.hang_up()
        self.reactor.close()


@pytest.fixture
def line() -> Iterator[Line]:
    line = Line()
    yield line
    line.close()


def test_a_message_arrives_as_it_was(line: Line) -> None:
    line.connect()
    assert line.next() == Word("will", WILL)
    said = Message("a/b", b"\x00\xff", QoS.LATEST)
    line.news.record(said)
    word = line.next()
    assert word == Word("record", said)
    assert word is not None
    assert isinstance(word.message.qos, QoS)


def test_a_new_listener_hears_the_will_and_the_present_states_first(line: Line) -> None:
    line.news.state(Message("a", b"old"))
    line.news.state(Message("a", b"new"))
    line.news.state(Message("b", b"1"))
    line.connect()
    line.news.record(Message("logs", b"2"))
    expected = [("will", b"gone"), ("state", b"new"), ("state", b"1")]
    assert line.heard() == [*expected, ("record", b"2")]
    line.connect()
    assert line.heard() == expected


def test_records_that_nobody_can_hear_are_counted(line: Line) -> None:
    line.news.record(Message("logs", b"early"))
    assert line.news.dropped == 1
    line.connect()
    line.hang_up()
    line.news.record(Message("logs", b"the listener has died"))
    line.news.record(Message("logs", b"x" * WORD_LIMIT))
    assert line.news.dropped == 3


def test_a_listener_who_does_not_read_holds_nobody_up(line: Line) -> None:
    line.connect()
    assert 50 < line.fill() < 5000


def test_states_are_not_lost_to_a_flood_of_records(line: Line) -> None:
    line.connect()
    line.fill()
    line.news.state(Message("a", b"old"))
    line.news.state(Message("a", b"new"))
    line.heard()
    heard: list[tuple[str, bytes]] = []
    assert line.reactor.run_until(lambda: bool(heard.extend(line.heard()) or heard), 5)
    assert heard == [("state", b"new")]


def test_the_end_is_heard(line: Line) -> None:
    line.connect()
    line.news.close()
    assert line.next() == Word("will", WILL)
    assert line.next() is None
