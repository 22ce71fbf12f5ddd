from __future__ import annotations

import json
import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from pebble.launched import Notifier
from pebble.launcher.announcer import Announcer
from pebble.launcher.news import News
from pebble.launcher.reactor import Reactor
from pebble.transports import Message, State
from tests.fakes.recording_transport import RecordingTransport
from tests.support import until


class Told:
    """An announcer on a thread of the test, what it is told, and what it has sent."""

    def __init__(self, folder: Path) -> None:
        self._file = folder / "record"
        self.transport = RecordingTransport("announcer", self._file)
        self.news = News(Reactor())
        self._descriptor = self.news.connect(Message("will", b"{}"))
        os.read(self._descriptor, 1000)  # the will; the transport has it already
        self.announcer = Announcer(self._descriptor, self.transport)
        self._thread = threading.Thread(target=self.announcer.run, args=(Notifier(),))
        self._thread.start()
        assert until(lambda: self.transport.state is State.CONNECTED)

    def state(self, number: int) -> None:
        self.news.state(message("status", number))

    def record(self, number: int) -> None:
        self.news.record(message("logs", number))

    def sent(self, topic: str) -> list[Any]:
        lines = self._file.read_text().rpartition("\n")[0].splitlines() if self._file.exists() else []
        parsed = [json.loads(line) for line in lines]
        return [line["payload"]["t"] for line in parsed if line["topic"] == topic]

    def join(self) -> None:
        self._thread.join(10)
        assert not self._thread.is_alive()

    def close(self) -> None:
        self.news.close()
        self.join()
        os.close(self._descriptor)


@pytest.fixture
def told(tmp_path: Path) -> Iterator[Told]:
    told = Told(tmp_path)
    yield told
    told.close()


def message(topic: str, number: int) -> Message:
    return Message(topic, json.dumps({"t": number}).encode())


def becomes(what: Callable[[], list[Any]], expected: list[Any]) -> bool:
    return until(lambda: what() == expected)


def test_state_is_said_again_on_the_next_connection(told: Told) -> None:
    told.state(1)
    assert until(lambda: told.sent("status")[-1:] == [1])
    told.transport.lose()
    told.state(2)
    before = len(told.sent("status"))
    assert until(lambda: told.transport.counters["refused"] == 1)
    told.transport.find()
    assert until(lambda: len(told.sent("status")) > before)
    assert told.sent("status")[-1] == 2


def test_records_are_not_kept_for_later(told: Told) -> None:
    told.record(1)
    assert becomes(lambda: told.sent("logs"), [1])
    told.transport.lose()
    told.record(2)
    assert until(lambda: told.transport.counters["refused"] == 1)
    told.transport.find()
    told.record(3)
    assert becomes(lambda: told.sent("logs"), [1, 3])


def test_the_last_word_is_said_before_the_end(told: Told) -> None:
    told.state(7)
    told.record(8)
    told.announcer.stop()
    told.join()
    assert (told.sent("status")[-1], told.sent("logs")) == (7, [8])
    assert told.transport.state is State.CLOSED


def test_it_ends_with_the_launcher(told: Told) -> None:
    told.state(7)
    told.news.close()
    told.join()
    assert told.sent("status")[-1] == 7
