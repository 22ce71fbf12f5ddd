"""What the hub remembers, without a hub."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from pebble.transports import QoS
from pebble.transports.zenoh.hub import store as hub_store
from pebble.transports.zenoh.hub.records import Record, Retained, StoredWill
from pebble.transports.zenoh.hub.store import HubStore
from pebble.transports.zenoh.wire import Hello, Stamp, Will, digest

WILL = Will("status", b"gone", QoS.DELIVERED, True)


def retained(key: str, payload: bytes, origin: str = "") -> Retained:
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


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Room for 100 bytes."""
    monkeypatch.setattr(hub_store, "MAX_BYTES", 100)
    monkeypatch.setattr(hub_store, "OVERHEAD", 0)
    monkeypatch.setattr(hub_store, "MAX_WILLS", 1)


@pytest.mark.usefixtures("small")
def test_what_has_no_room_is_refused_and_leaves_the_others_and_its_own_older_value(
    caplog: pytest.LogCaptureFixture,
) -> None:
    made = store(retained("a", bytes(90)), retained("b", bytes(20)), retained("a", bytes(95)))
    assert [len(record.payload) for record in made.retained()] == [95]
    assert not made.apply(retained("a", bytes(100)))
    assert [len(record.payload) for record in made.retained()] == [95]
    assert made.apply(retained("a", b""))
    assert made.apply(retained("b", bytes(99)))
    made.apply(StoredWill("first", replace(WILL, payload=b"")))
    assert (made.wills(), made.refused) == (set(), 3)
    made.apply(retained("b", b""))
    made.apply(StoredWill("first", WILL))
    made.apply(StoredWill("second", WILL))
    assert (made.wills(), made.refused) == ({"first"}, 4)
    assert "no room for the retained message of b" in caplog.text


@pytest.mark.usefixtures("small")
def test_long_names_take_room_too() -> None:
    made = store(retained("a", b"1", "x" * 1000), StoredWill("client", Will("a", b"", QoS.DELIVERED, True, "x" * 1000)))
    assert (made.retained(), made.wills(), made.refused) == ([], set(), 2)
