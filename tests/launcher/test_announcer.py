from __future__ import annotations

import json
import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from pebble.launcher.announcer import Announcer
from pebble.launcher.announcer_pipe import AnnouncerPipe
from pebble.launcher.reactor import Reactor
from pebble.runtime.parent import Notifier
from pebble.transports import Message, State
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
