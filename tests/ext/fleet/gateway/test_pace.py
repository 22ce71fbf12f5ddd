"""How much of what is sent to one robot passes a gateway in a second, and that the last of it always does."""

from __future__ import annotations

import pytest

from pebble.extensions.fleet.gateway import pace as module
from pebble.extensions.fleet.gateway.pace import Pace, Senders
from pebble.transports import Message


class Timed:
    def __init__(self, each: int, together: int = 1000) -> None:
        self.now, self.passed = 10.0, list[str]()
        self.pace = Pace(lambda: self.now, each, together)

    def send(self, *topics: str, at: float, key: str = "") -> None:
        """Each message has its number as its payload."""
        self.now = at
        for number, topic in enumerate(topics):
            message = Message(topic, b"%d" % number)
            if self.pace.takes(message, key or topic):
                self._note(message)

    def flush(self, at: float) -> None:
        self.now = at
        for message in self.pace.due():
            self._note(message)

    def _note(self, message: Message) -> None:
        self.passed.append(f"{message.topic}{message.payload.decode()}")


def test_the_last_one_of_a_topic_waits_for_the_next_second() -> None:
    timed = Timed(2)
    timed.send(*"aaaab", at=10.1)
    timed.flush(10.9)
    assert timed.passed == ["a0", "a1", "b4"]
    timed.send(*"bbb", at=11.0)
    timed.flush(11.0)
    assert timed.passed[3:] == ["b0", "b1", "a3"], "another topic goes on"
    timed.flush(12.0)
    assert timed.passed[6:] == ["b2"]


def test_it_is_dropped_for_a_newer_one() -> None:
    timed = Timed(1)
    timed.send(*"aa", at=10.1)
    timed.send("a", at=11.0)
    timed.flush(12.0)
    assert timed.passed == ["a0", "a0"]


@pytest.mark.parametrize(
    ("topics", "key", "passed"),
    [
        ("aabbcc", "", 3),  # together
        ("aabbcc", "invented", 2),
    ],
)
def test_many_topics_are_counted_together(topics: str, key: str, passed: int) -> None:
    timed = Timed(2, 3)
    timed.send(*topics, at=10.1, key=key)
    assert len(timed.passed) == passed


def test_neither_what_is_counted_nor_what_waits_grows_without_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_TOPICS", 3)
    monkeypatch.setattr(module, "_WAITING", 1)
    timed = Timed(1)
    timed.send(*"abcdefabcdef", at=10.1)
    assert timed.passed == ["a0", "b1", "c2", "d3"]
    timed.flush(11.0)
    assert len(timed.passed) == 5


def test_a_stop_is_counted_with_its_sender(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_SENDERS", 3)
    now = [10.0]
    senders = Senders({"a/b/goob"}, lambda: now[0])

    def key(topic: str, payload: bytes) -> str:
        return senders.key(Message(topic, payload))

    plain, named = "a/b/goob/incoming/estop", "a/b/goob/incoming/by/ann/estop"
    found = [key(plain, b'{"by": "ann"}'), key(plain, b'{"by": "vera"}'), key(named, b"nonsense")]
    assert len(set(found)) == 3
    assert key(plain, b'{"by": "invented"}') == "a/b/goob"
    assert key(plain, b'{"by": "ann"}') == found[0]
    assert key("a/b/nowhere/incoming/estop", b"") == ""
    now[0] = 11.0
    assert key(plain, b'{"by": "invented"}') != "a/b/goob"
