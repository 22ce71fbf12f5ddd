"""What the hub remembers, without a hub."""

from __future__ import annotations

import pytest

from pebble.transports import QoS, kept_store
from pebble.transports.kept_store import Kept, KeptStore, Parked, Record
from pebble.transports.zenoh_wire import Hello, Stamp, Will, digest

WILL = Will("status", b"gone", QoS.DELIVERED, True)


def kept(key: str, payload: bytes, origin: str = "writer") -> Kept:
    return Kept(key, payload, Stamp(QoS.DELIVERED, 1, origin))


def store(*records: Record) -> KeptStore:
    made = KeptStore()
    for record in records:
        made.apply(record)
    return made


def test_the_newest_counts_and_an_empty_payload_removes() -> None:
    made = store(kept("a", b"1"), kept("b", b"1"), kept("a", b"2"), kept("b", b""))
    assert made.kept() == [kept("a", b"2")]
    assert (made.get("a"), made.get("b")) == (kept("a", b"2"), None)


def test_apply_tells_what_changed() -> None:
    made = store(kept("a", b"1"))
    assert not made.apply(kept("a", b"1"))
    assert made.apply(kept("a", b"2"))
    assert made.apply(kept("a", b""))
    assert not made.apply(kept("a", b""))
    assert made.apply(Parked("client", WILL))
    assert not made.apply(Parked("client", WILL))
    assert made.apply(Parked("client", None))
    assert not made.apply(Parked("client", None))


@pytest.mark.parametrize(
    ("own", "lacking"),
    [
        ({"new": 1}, ["new"]),
        ({"mine": digest(b"1")}, []),
        ({"mine": digest(b"2")}, ["mine"]),
        ({"theirs": digest(b"2")}, []),
        ({"mine": None}, ["mine"]),
        ({"theirs": None, "new": None}, []),
    ],
)
def test_a_client_is_asked_for_what_is_missing_or_its_own_and_changed(
    own: dict[str, int | None], lacking: list[str]
) -> None:
    made = store(kept("mine", b"1", "me"), kept("theirs", b"1", "somebody"))
    assert made.lacks(Hello("me", 5, None, own)) == lacking


def test_its_records_make_an_equal_store() -> None:
    made = store(kept("b", b"1"), kept("a", b"2"), Parked("client", WILL), kept("b", b""))
    copy = store(*made.records())
    assert (copy.kept(), copy.wills(), copy.will("client")) == (made.kept(), {"client"}, WILL)


def test_it_is_bounded(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setattr(kept_store, "MAX_BYTES", 100)
    monkeypatch.setattr(kept_store, "MAX_WILLS", 1)
    made = store(kept("a", bytes(90)), kept("b", bytes(20)), kept("a", bytes(95)))
    assert [record.key for record in made.kept()] == ["a"]
    made.apply(kept("a", bytes(100)))
    assert made.kept() == []  # better none than an old one
    made.apply(kept("b", bytes(99)))
    assert [record.key for record in made.kept()] == ["b"]
    made.apply(Parked("first", WILL))
    made.apply(Parked("second", WILL))
    assert made.wills() == {"first"}
    assert made.refused == 3
    assert "no room for the kept copy of b" in caplog.text
