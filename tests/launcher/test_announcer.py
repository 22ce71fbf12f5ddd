from __future__ import annotations

import json
import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from pebble.launcher.announcer import Announcer
from pebble.launcher.announcer_pipe import ENVELOPE_LIMIT, AnnouncerPipe, Envelope, next_envelope
from pebble.launcher.reactor import Reactor
from pebble.runtime.parent import Notifier
from pebble.transports import Message, QoS, State
from tests.fakes.recording_transport import RecordingTransport
from tests.support import until


class ConnectedAnnouncer:
    """An announcer on a thread of the test, its pipe, and what it has sent."""

    def __init__(self, folder: Path) -> None:
        self._file = folder / "record"
        self.transport = RecordingTransport("announcer", self._file)
        self.pipe = AnnouncerPipe(Reactor())
        self._descriptor = self.pipe.connect(Message("will", b"{}"))
        os.read(self._descriptor, 1000)  # the will; the transport has it already
        self.announcer = Announcer(self._descriptor, self.transport)
        self._thread = threading.Thread(target=self.announcer.run, args=(Notifier(),))
        self._thread.start()
        assert until(lambda: self.transport.state is State.CONNECTED)

    def state(self, number: int) -> None:
        self.pipe.state(message("status", number))

    def record(self, number: int) -> None:
        self.pipe.record(message("logs", number))

    def sent(self, topic: str) -> list[Any]:
        lines = self._file.read_text().rpartition("\n")[0].splitlines() if self._file.exists() else []
        parsed = [json.loads(line) for line in lines]
        return [line["payload"]["t"] for line in parsed if line["topic"] == topic]

    def join(self) -> None:
        self._thread.join(10)
        assert not self._thread.is_alive()

    def close(self) -> None:
        self.pipe.close()
        self.join()
        os.close(self._descriptor)


@pytest.fixture
def connected(tmp_path: Path) -> Iterator[ConnectedAnnouncer]:
    connected = ConnectedAnnouncer(tmp_path)
    yield connected
    connected.close()


def message(topic: str, number: int) -> Message:
    return Message(topic, json.dumps({"t": number}).encode())


def becomes(what: Callable[[], list[Any]], expected: list[Any]) -> bool:
    return until(lambda: what() == expected)


def test_states_are_published_again_on_the_next_connection(connected: ConnectedAnnouncer) -> None:
    connected.state(1)
    assert until(lambda: connected.sent("status")[-1:] == [1])
    connected.transport.lose()
    connected.state(2)
    before = len(connected.sent("status"))
    assert until(lambda: connected.transport.counters["refused"] == 1)
    connected.transport.find()
    assert until(lambda: len(connected.sent("status")) > before)
    assert connected.sent("status")[-1] == 2
    connected.state(7)
    connected.pipe.close()
    connected.join()
    assert connected.sent("status")[-1] == 7, "it ends with the launcher"


def test_records_are_published_only_once(connected: ConnectedAnnouncer) -> None:
    connected.record(1)
    assert becomes(lambda: connected.sent("logs"), [1])
    connected.transport.lose()
    connected.record(2)
    assert until(lambda: connected.transport.counters["refused"] == 1)
    connected.transport.find()
    connected.record(3)
    assert becomes(lambda: connected.sent("logs"), [1, 3])


def test_a_failure_to_publish_does_not_end_it(
    connected: ConnectedAnnouncer, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with monkeypatch.context() as broken:
        broken.setattr(connected.transport, "publish", lambda *_, **__: 1 // 0)
        connected.record(1)
        connected.state(2)
        assert until(lambda: [record.args for record in caplog.records] == [("logs", 1), ("status", 1)])
    connected.record(3)
    assert becomes(lambda: connected.sent("logs"), [3])


# -- the pipe between launcher and announcer

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
