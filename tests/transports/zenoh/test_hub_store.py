"""What the hub remembers, without a hub."""

from __future__ import annotations

import pytest

from pebble.transports import QoS
from pebble.transports.zenoh.hub import store as hub_store
from pebble.transports.zenoh.hub.store import HubStore, Record, Retained, StoredWill
from pebble.transports.zenoh.wire import Hello, Stamp, Will, digest

WILL = Will("status", b"gone", QoS.DELIVERED, True)


def retained(key: str, payload: bytes, origin: str = "writer") -> Retained:
    return Retained(key, payload, Stamp(QoS.DELIVERED, 1, origin))


def store(*records: Record) -> HubStore:
    made = HubStore()
    for record in records:
        made.apply(record)
    return made


def test_the_newest_counts_and_an_empty_payload_removes() -> None:
    made = store(retained("a", b"1"), retained("b", b"1"), retained("a", b"2"), retained("b", b""))
    assert made.retained() == [retained("a", b"2")]
    assert (made.get("a"), made.get("b")) == (retained("a", b"2"), None)


def test_apply_returns_whether_anything_changed() -> None:
    made = store(retained("a", b"1"))
    assert not made.apply(retained("a", b"1"))
    assert made.apply(retained("a", b"2"))
    assert made.apply(retained("a", b""))
    assert not made.apply(retained("a", b""))
    assert made.apply(StoredWill("client", WILL))
    assert not made.apply(StoredWill("client", WILL))
    assert made.apply(StoredWill("client", None))
    assert not made.apply(StoredWill("client", None))


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
    made = store(retained("mine", b"1", "me"), retained("theirs", b"1", "somebody"))
    assert made.lacks(Hello("me", 5, None, own)) == lacking


def test_its_records_make_an_equal_store() -> None:
    made = store(retained("b", b"1"), retained("a", b"2"), StoredWill("client", WILL), retained("b", b""))
    copy = store(*made.records())
    assert (copy.retained(), copy.wills(), copy.will("client")) == (made.retained(), {"client"}, WILL)


def test_it_is_bounded(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setattr(hub_store, "MAX_BYTES", 100)
    monkeypatch.setattr(hub_store, "MAX_WILLS", 1)
    made = store(retained("a", bytes(90)), retained("b", bytes(20)), retained("a", bytes(95)))
    assert [record.key for record in made.retained()] == ["a"]
    made.apply(retained("a", bytes(100)))
    assert made.retained() == []  # better none than an old one
    made.apply(retained("b", bytes(99)))
    assert [record.key for record in made.retained()] == ["b"]
    made.apply(StoredWill("first", WILL))
    made.apply(StoredWill("second", WILL))
    assert made.wills() == {"first"}
    assert made.refused == 3
    assert "no room for the retained message of b" in caplog.text
