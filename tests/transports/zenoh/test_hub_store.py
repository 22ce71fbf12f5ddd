"""What the hub remembers, without a hub."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from pebble.transports import QoS
from pebble.transports.zenoh.hub import store as hub_store
from pebble.transports.zenoh.hub.records import Record, Retained, StoredWill
from pebble.transports.zenoh.hub.store import MAX_WILLS, RESERVED_WILLS, HubStore
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
    """Room for 100 bytes, 40 of them reserved."""
    monkeypatch.setattr(hub_store, "MAX_BYTES", 100)
    monkeypatch.setattr(hub_store, "RESERVED_BYTES", 40)
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


@pytest.mark.usefixtures("small")
def test_at_a_hub_of_several_no_robot_fills_the_room_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hub_store, "ROBOT_BYTES", 50)
    made = store(*(retained(f"a/b/{name}", bytes(25)) for name in ("x/1", "x/2", "y/1", "y/2")))
    assert [one.key for one in made.retained()] == ["a/b/x/1", "a/b/y/1"]
    made.apply(retained("a/b/x/1", b""))
    assert made.apply(retained("a/b/x/2", bytes(25)))


@pytest.mark.usefixtures("small")
def test_what_others_store_leaves_the_reserved_room() -> None:
    made = HubStore(("robot/outgoing/",))
    for number in range(10):
        made.apply(retained(f"robot/incoming/{number}", bytes(10)))
    made.apply(StoredWill("stranger", Will("elsewhere", bytes(40), QoS.DELIVERED, True)))
    assert len(made.retained()) == 2
    assert made.wills() == set()
    assert made.apply(retained("robot/outgoing/state", bytes(20)))
    assert not made.apply(retained("robot/outgoing/state", bytes(90)))
    made = store(*made.records())
    assert len(made.retained()) == 3


def test_wills_of_others_leave_places_for_those_of_the_reserved_keys() -> None:
    made, will = HubStore(("robot/outgoing/",)), Will("elsewhere", b"", QoS.DELIVERED, True)
    for number in range(MAX_WILLS):
        made.apply(StoredWill(f"stranger{number}", will))
    own = Will("robot/outgoing/online", b"", QoS.DELIVERED, True)
    assert [made.apply(StoredWill(f"own{number}", own)) for number in range(RESERVED_WILLS + 1)] == [
        *[True] * RESERVED_WILLS,
        False,
    ]


@pytest.mark.usefixtures("small")
def test_the_reserved_may_use_all_room_and_return_it() -> None:
    made = HubStore(("robot/outgoing/",))
    state = retained("robot/outgoing/state", bytes(80))
    assert made.apply(state)
    assert not made.apply(retained("robot/incoming/x", b"1"))
    assert made.apply(retained(state.key, b"1"))
    assert made.apply(retained("robot/incoming/x", bytes(40)))
    assert not made.apply(retained("robot/incoming/y", bytes(20)))
    assert made.apply(retained("robot/incoming/x", b""))
    assert made.apply(retained("robot/incoming/y", bytes(40)))
