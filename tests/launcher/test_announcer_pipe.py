from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from pebble.launcher.announcer_pipe import ENVELOPE_LIMIT, AnnouncerPipe, Envelope, next_envelope
from pebble.launcher.reactor import Reactor
from pebble.transports import Message, QoS

WILL = Message("status", b"gone", QoS.DELIVERED, retain=True)


class Connection:
    """The pipe, and an announcer that reads when asked."""

    def __init__(self) -> None:
        self.reactor = Reactor()
        self.pipe = AnnouncerPipe(self.reactor)
        self._announcer: int | None = None

    def connect(self) -> None:
        self.hang_up()
        self._announcer = self.pipe.connect(WILL)
        os.set_blocking(self._announcer, False)

    def hang_up(self) -> None:
        if self._announcer is not None:
            os.close(self._announcer)
            self._announcer = None

    def next(self) -> Envelope | None:
        assert self._announcer is not None
        return next_envelope(self._announcer)

    def received(self) -> list[tuple[str, bytes]]:
        """Kind and payload of every envelope in the pipe."""
        envelopes = []
        try:
            while (envelope := self.next()) is not None:
                envelopes.append((envelope.kind, envelope.message.payload))
        except BlockingIOError:
            pass
        return envelopes

    def fill(self) -> int:
        """Records until one is dropped; returns how many there was room for."""
        count = 0
        while not self.pipe.dropped:
            self.pipe.record(Message("logs", b"x" * 500))
            count += 1
        return count - 1

    def close(self) -> None:
        self.pipe.close()
        self.hang_up()
        self.reactor.close()


@pytest.fixture
def connection() -> Iterator[Connection]:
    connection = Connection()
    yield connection
    connection.close()


def test_messages_arrive_as_they_were_and_then_the_end_of_the_pipe(connection: Connection) -> None:
    connection.connect()
    assert connection.next() == Envelope("will", WILL)
    sent = Message("a/b", b"\x00\xff", QoS.LATEST)
    connection.pipe.record(sent)
    envelope = connection.next()
    assert envelope == Envelope("record", sent)
    assert envelope is not None
    assert isinstance(envelope.message.qos, QoS)
    connection.pipe.close()
    assert connection.next() is None


def test_a_new_announcer_receives_the_will_and_the_present_states_first(connection: Connection) -> None:
    connection.pipe.state(Message("a", b"old"))
    connection.pipe.state(Message("a", b"new"))
    connection.pipe.state(Message("b", b"1"))
    connection.connect()
    connection.pipe.record(Message("logs", b"2"))
    expected = [("will", b"gone"), ("state", b"new"), ("state", b"1")]
    assert connection.received() == [*expected, ("record", b"2")]
    connection.connect()
    assert connection.received() == expected


def test_records_that_cannot_be_sent_are_counted(connection: Connection) -> None:
    connection.pipe.record(Message("logs", b"early"))
    assert connection.pipe.dropped == 1
    connection.connect()
    connection.hang_up()
    connection.pipe.record(Message("logs", b"the announcer has died"))
    connection.pipe.record(Message("logs", b"x" * ENVELOPE_LIMIT))
    assert connection.pipe.dropped == 3


def test_states_are_not_lost_to_a_flood_of_records(connection: Connection) -> None:
    connection.connect()
    assert 50 < connection.fill() < 5000, "the launcher does not wait for an announcer that does not read"
    connection.pipe.state(Message("a", b"old"))
    connection.pipe.state(Message("a", b"new"))
    connection.received()
    received: list[tuple[str, bytes]] = []
    assert connection.reactor.run_until(lambda: bool(received.extend(connection.received()) or received), 5)
    assert received == [("state", b"new")]
