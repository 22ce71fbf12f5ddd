"""What waits for a slow socket is bounded, and the newest wins."""

from __future__ import annotations

from pebble.transports import Message
from pebble.transports.mqtt_backlog import BYTES, MESSAGES, Backlog


def drain(backlog: Backlog) -> list[bytes]:
    taken = []
    while backlog:
        taken.append(backlog.take().payload)
    return taken


def test_the_oldest_gives_way() -> None:
    backlog = Backlog()
    dropped = sum(backlog.put(Message("a", b"%d" % number)) for number in range(MESSAGES + 10))
    assert dropped == 10
    assert drain(backlog) == [b"%d" % number for number in range(10, MESSAGES + 10)]


def test_bytes_are_bounded_but_one_message_may_always_wait() -> None:
    backlog = Backlog()
    assert backlog.put(Message("a", b"1" * BYTES * 3)) == 0
    assert backlog.put(Message("a", b"2" * (BYTES - 1))) == 1
    assert backlog.put(Message("a", b"3")) == 0
    assert [payload[:1] for payload in drain(backlog)] == [b"2", b"3"]


def test_a_kept_message_gives_way_only_to_a_newer_one_of_its_topic() -> None:
    backlog = Backlog()
    backlog.put(Message("state", b"old", retain=True))
    backlog.put(Message("other", b"other", retain=True))
    for _ in range(MESSAGES * 2):
        backlog.put(Message("a", b"x"))
    assert backlog.put(Message("state", b"new", retain=True)) == 1
    taken = drain(backlog)
    assert taken[0] == b"other"
    assert taken[-1] == b"new"
    assert len(taken) == MESSAGES + 2


def test_a_delivered_message_makes_what_waits_on_its_topic_stale() -> None:
    backlog = Backlog()
    for message in (Message("a", b"1"), Message("b", b"2"), Message("a", b"3", retain=True)):
        backlog.put(message)
    assert backlog.supersede(Message("a", b"4")) == 1
    assert backlog.supersede(Message("a", b"5", retain=True)) == 1
    assert drain(backlog) == [b"2"]
    assert not backlog
