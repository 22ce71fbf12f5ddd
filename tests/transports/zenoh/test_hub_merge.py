"""Two hubs that were apart agree: without hubs, by tables."""

from __future__ import annotations

import itertools
import random

import pytest
from msgspec.structs import replace

from pebble.transports import QoS
from pebble.transports.zenoh.hub import history as hub_history
from pebble.transports.zenoh.hub.history import History
from pebble.transports.zenoh.hub.merge import (
    MAX_BYTES,
    Row,
    Value,
    compare,
    decode_values,
    encode,
    in_parts,
    is_newer,
    is_overtaken,
    known_ages,
    published,
)
from pebble.transports.zenoh.hub.records import Retained
from pebble.transports.zenoh.hub.store import HubStore
from pebble.transports.zenoh.wire import Hello, Stamp, digest

OLD = float("inf")


def row(digest: int | None, origin: str = "me", count: int = 0, age_s: float = 1.0) -> Row:
    return Row(digest, origin, count, age_s)


@pytest.mark.parametrize(
    ("theirs", "mine", "newer"),
    [
        pytest.param(row(1), None, True, id="missing here"),
        pytest.param(row(None), None, False, id="removed there, never here"),
        pytest.param(row(1, age_s=0), row(1, "you", age_s=9), False, id="equal bytes"),
        pytest.param(row(1, "you", age_s=1), row(2, "me", age_s=2), True, id="younger"),
        pytest.param(row(1, "you", age_s=2), row(2, "me", age_s=1), False, id="older"),
        pytest.param(row(None, "you", age_s=1), row(2, "me", age_s=2), True, id="a younger removal"),
        pytest.param(row(2, "you", age_s=2), row(None, "me", age_s=1), False, id="an older value than the removal"),
        pytest.param(row(1, "you", age_s=1.05), row(2, "me", age_s=1), True, id="as old: the greater origin"),
        pytest.param(
            row(2, "me", age_s=1.05), row(1, "me", age_s=1), True, id="as old, one origin: the greater digest"
        ),
        pytest.param(row(1, "me", 7, age_s=9), row(2, "me", 6, age_s=1), True, id="one origin: its later message"),
        pytest.param(row(1, "me", 6, age_s=1), row(2, "me", 7, age_s=9), False, id="one origin: its earlier message"),
        pytest.param(row(1, "alive", 7, 1), row(2, "alive", 6, 9), False, id="the origin is there and says itself"),
        pytest.param(row(1, "you", age_s=OLD), row(2, "me", age_s=100), False, id="of a journal"),
        pytest.param(row(1, "you", age_s=OLD), row(2, "me", age_s=OLD), True, id="both of journals"),
    ],
)
def test_newer(theirs: Row, mine: Row | None, newer: bool) -> None:
    assert is_newer(theirs, mine, {"alive"}) is newer


@pytest.mark.parametrize("seed", range(20))
def test_both_are_equal_afterwards_whichever_decides(seed: int) -> None:
    chosen = random.Random(seed)

    def table() -> dict[str, Row]:
        ages = (0.0, 0.05, 0.2, 5.0, OLD)
        return {
            str(key): row(
                chosen.choice((None, 1, 2)), chosen.choice("ab"), chosen.choice((0, 1, 2)), chosen.choice(ages)
            )
            for key in chosen.sample(range(40), 30)
        }

    ends = []
    mine, theirs = table(), table()
    for a, b in ((mine, theirs), (theirs, mine)):
        want, give = compare(a, b, ())
        a_after, b_after = a | {key: b[key] for key in want}, b | {key: a[key] for key in give}
        values = [{key: one.digest for key, one in after.items() if one.digest} for after in (a_after, b_after)]
        assert values[0] == values[1]
        ends.append(values[0])
    assert ends[0] == ends[1]


@pytest.mark.parametrize(
    ("mine", "overtaken"), [(None, False), (row(1, age_s=1.1), False), (row(1, age_s=0.9), True), (row(None), False)]
)
def test_what_came_while_it_was_asked_for_is_not_overwritten(mine: Row | None, overtaken: bool) -> None:
    assert is_overtaken(mine, 1.0) is overtaken


def test_what_a_journal_had_is_as_old_as_another_hub_knows_and_no_third_ones_older_value_replaces_it() -> None:
    first = {"k": row(2, age_s=5.0), "gone": row(None, "you", age_s=5.0), "other": row(1)}
    restarted = {"k": row(2, age_s=OLD), "gone": row(None, "you", age_s=OLD), "other": row(2, age_s=OLD)}
    third = {"k": row(1, age_s=12.0), "gone": row(1, age_s=12.0)}
    ages = known_ages(restarted, first)
    assert ages == {"k": 5.0, "gone": 5.0}
    assert known_ages(first, restarted) == {}
    known = {key: replace(one, age_s=ages.get(key, one.age_s)) for key, one in restarted.items()}
    assert compare(restarted, third, ()) == (["k", "gone"], ["other"])
    assert compare(known, third, ()) == ([], ["k", "gone", "other"])


@pytest.mark.parametrize(
    ("wills", "rows", "there"),
    [
        pytest.param([], {"k": row(1)}, ["c"], id="it has something there, and no will"),
        pytest.param(["c"], {"k": row(1)}, [], id="it still has the will"),
        pytest.param([], {}, [], id="it knows nothing of it: it has just begun"),
    ],
)
def test_wills_that_were_published_while_a_hub_was_away(
    wills: list[str], rows: dict[str, Row], there: list[str]
) -> None:
    assert published({"c": "k"}, rows, wills) == there


def value(key: str, payload: bytes = b"1", age_s: float = 0.0) -> Value:
    return Value(key, payload, QoS.DELIVERED, 1, "me", age_s)


def test_large_values_go_in_parts() -> None:
    values = [value(str(number), bytes(MAX_BYTES // 3)) for number in range(10)]
    parts = list(in_parts(iter(values)))
    assert list(itertools.chain(*parts)) == values
    assert [len(part) for part in parts] == [3, 3, 3, 1]
    assert list(in_parts(iter(()))) == [[]]


@pytest.mark.parametrize("age_s", [float("nan"), -1.0])
def test_an_age_that_is_none_is_refused(age_s: float) -> None:
    with pytest.raises(ValueError, match="an age of"):
        decode_values(encode([value("k", age_s=age_s)]))


# -- what a store remembers for it


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def retained(key: str, payload: bytes, origin: str = "me") -> Retained:
    return Retained(key, payload, Stamp(QoS.DELIVERED, 1, origin))


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def store(clock: Clock) -> HubStore:
    return HubStore(history=History(clock))


def test_a_store_knows_how_old_its_values_and_removals_are(store: HubStore, clock: Clock) -> None:
    store.apply(retained("a", b"1"))
    store.apply(retained("b", b"1"))
    store.apply(retained("c", b"1"), OLD)
    clock.now += 2
    store.apply(retained("b", b"", "you"))
    store.apply(retained("never", b""))
    ages = {key: (one.digest is None, one.origin, one.age_s) for key, one in store.table().items()}
    assert ages == {"a": (False, "me", 2), "b": (True, "you", 0), "c": (False, "me", OLD)}
    assert [one.payload for one in store.values(["a", "b", "never"])] == [b"1", b""]


def test_a_store_learns_how_old_that_of_a_journal_is(store: HubStore) -> None:
    store.apply(retained("a", b"1"), OLD)
    store.apply(retained("b", b"1"))
    store.apply(retained("c", b"1"))
    store.apply(retained("c", b"", "you"), OLD)
    store.know({"a": 3.0, "b": 3.0, "c": 4.0, "never": 3.0})
    assert {key: one.age_s for key, one in store.table().items()} == {"a": 3.0, "b": 0.0, "c": 4.0}


def test_a_client_is_not_asked_for_what_another_one_removed(store: HubStore) -> None:
    for key, by in (("mine", "me"), ("theirs", "you"), ("later", "you")):
        store.apply(retained(key, b"1"))
        store.apply(retained(key, b"", by))
    own = {"mine": digest(b"1"), "theirs": digest(b"1"), "later": digest(b"2")}
    assert store.lacks(Hello("me", 1, None, own)) == ["mine", "later"], "but for what it wrote since"


def test_removals_outlive_a_restart_and_come_before_older_values(store: HubStore) -> None:
    store.apply(retained("a", b"1"))
    store.apply(retained("a", b"", "you"))
    copy = store.empty()
    for record in store.records():
        copy.apply(record, OLD)
    assert copy.row("a") == row(None, "you", 1, OLD)


@pytest.mark.parametrize(
    ("limit", "bound", "later"),
    [("MAX_REMOVALS", 3, 0.0), ("MAX_BYTES", 9, 0.0), ("REMOVAL_S", 5.0, 10.0)],
    ids=["number", "bytes", "days"],
)
def test_removals_are_bounded(
    store: HubStore, clock: Clock, monkeypatch: pytest.MonkeyPatch, limit: str, bound: float, later: float
) -> None:
    monkeypatch.setattr(hub_history, limit, bound)
    for key in "abcd":
        store.apply(retained(key, b"1"))
        store.apply(retained(key, b""))
        clock.now += later
    assert "d" in store.table()
    assert "a" not in store.table()
