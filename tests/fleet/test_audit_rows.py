"""What anybody can cause, and one person's flood, displace nothing that others did; in virtual time."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from pathlib import Path

import pytest

from pebble.fleet import audit as audit_module
from pebble.fleet.audit import Audit
from pebble.fleet.audit_rows import EACH, GROUPS, OTHERS, WAITING, Entry, Merging, new
from tests.support import cases, some

MANY = cases(5000, 100_000)
VIEWER = {"user": "viewer", "device": "phone", "address": "192.0.2.7"}


def robot(number: int) -> str:
    return f"pebble/robots/fake{number}"


def in_one_network(number: int) -> str:
    return f"2001:db8::{number >> 8:x}:{number & 255:x}"


#: Members of the kind: what a stranger, or one person, can cause MANY times within a minute; and the rows that it
#: may have then.
FLOODS: dict[str, tuple[Callable[[int], dict[str, str]], int]] = {
    "logins of one name": (lambda n: {"what": "login-refused", "user": "admin", "address": "192.0.2.1"}, 1),
    "logins of changing names": (lambda n: {"what": "login-refused", "user": f"u{n}\x1b[2J", "address": "::1"}, 1),
    "one name with commas": (lambda n: {"what": "login-refused", "user": ", " * (n % 200), "address": "::1"}, 1),
    "addresses of one /64": (
        lambda n: {"what": "login-limited", "user": "a", "address": in_one_network(n)},
        1,
    ),
    "a /64 for each": (
        lambda n: {"what": "login-limited", "user": "a", "address": f"2001:db8:{n >> 8:x}:{n & 255:x}::1"},
        GROUPS + 1,
    ),
    "changing IPv4 addresses": (
        lambda n: {"what": "login-refused", "user": "a", "address": f"10.{n >> 16}.{n >> 8 & 255}.{n & 255}"},
        GROUPS + 1,
    ),
    "lost rows": (lambda n: {"what": "audit-dropped"}, 1),
    "logins that succeed": (lambda n: {"what": "login", **VIEWER}, 1),
    "and from changing addresses": (
        lambda n: {"what": "login", **VIEWER, "address": in_one_network(n)},
        EACH + 1,
    ),
    "stops of one robot": (lambda n: {"what": "stop", "ref": robot(0), **VIEWER}, 1),
    "stops of invented robots": (lambda n: {"what": "stop", "ref": robot(n), **VIEWER}, EACH + 1),
    "stops with changing reasons": (lambda n: {"what": "stop", "detail": f"{n}", **VIEWER}, EACH + 1),
    "stops by changing devices": (lambda n: {"what": "stop", **VIEWER, "device": f"{n}"}, EACH + 1),
    "everything at once": (lambda n: {"what": "stop", "ref": robot(n), **VIEWER, "address": f"::{n:x}"}, EACH + 1),
    "talk on and off": (lambda n: {"what": "talk", "ref": robot(n % 2), **VIEWER}, 2),
    "take and release": (lambda n: {"what": ("take", "release")[n % 2], "ref": robot(0), **VIEWER}, 2),
    "names without a login": (lambda n: {"what": "take", "user": f"name {n}", "address": "::1"}, GROUPS + EACH),
}


@pytest.mark.timeout(600)  # some seconds of computing, on a machine that may be busy
@pytest.mark.parametrize("name", some(FLOODS, 2))
def test_a_flood_displaces_no_act(name: str) -> None:
    fields, most = FLOODS[name]
    merging, stored = Merging(), dict[int, Entry]()
    act = entry(what="drive", ref="pebble/robots/goob", user="ann")
    merging.add(act, 0.0)
    for number in range(MANY):
        merging.add(entry(**fields(number)), number / MANY)
        if number % WAITING == 0:
            stored |= {id(row): row for row in merging.take()}
    merging.add(entry(what="reset", ref="pebble/robots/goob", user="ann"), 1.0)
    stored |= {id(row): row for row in merging.take()}
    rows = [row for row in stored.values() if row.user != "ann"]
    assert [row.what for row in stored.values() if row.user == "ann"] == ["drive", "reset"]
    assert len(rows) <= most
    assert sum(row.count for row in rows) == MANY, "each is counted"
    assert merging.dropped == 0
    assert all(len(text) <= 202 for row in rows for text in (row.user, row.address, row.detail))


def test_a_queue_that_is_full_of_what_was_refused_has_room_for_acts() -> None:
    merging = Merging()
    for minute in range(100):  # nothing is taken: the disk stands still
        for number in range(GROUPS):
            merging.add(entry(what="login-refused", address=f"10.0.0.{number}"), 60.0 * minute)
    merging.add(entry(what="drive", user="ann"), 6000.0)
    rows = merging.take()
    assert sum(row.refused for row in rows) == WAITING
    assert [row.user for row in rows if not row.refused] == ["ann"]
    assert sum(row.count for row in rows) + merging.dropped == 100 * GROUPS + 1
    merging.give_back(rows)
    assert merging.take() == rows


def test_what_happens_again_within_a_minute_is_one_row_and_what_differs_is_not() -> None:
    merging = Merging()
    for at in (0.0, 30.0, 59.0, 61.0):
        merging.add(entry(what="action", detail="name reboot", user="ann", at=at), at)
        merging.add(entry(what="action", detail="name git-pull", user="ann", at=at), at)
    assert [(row.detail, row.at, row.last, row.count) for row in merging.take()] == [
        ("name reboot", 0.0, 59.0, 3),
        ("name git-pull", 0.0, 59.0, 3),
        ("name reboot", 61.0, 61.0, 1),
        ("name git-pull", 61.0, 61.0, 1),
    ]


def test_refused_rows_name_who_was_tried_and_the_network() -> None:
    merging = Merging()
    for number, user in enumerate(("ann", "bob", "ann")):
        merging.add(entry(what="login-refused", user=user, address=f"2001:db8::{number}"), 0.0)
    assert [(row.user, row.address, row.count) for row in merging.take()] == [("ann, bob", "2001:db8::/64", 3)]


def test_beyond_the_quota_a_row_counts_the_others() -> None:
    merging = Merging()
    for number in range(EACH + 5):
        merging.add(entry(what="stop", ref=robot(number), user="ann", detail="x"), 0.0)
    last = merging.take()[-1]
    assert (last.ref, last.user, last.detail, last.count) == (OTHERS, "ann", "", 5)


@pytest.mark.parametrize(("what", "table", "left"), [("login-refused", "refused", 30), ("stop", "audit", 50)])
def test_a_table_loses_the_oldest_of_who_has_most(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, what: str, table: str, left: int
) -> None:
    for name, value in {"MAX_ACTS": 52, "MAX_REFUSED": 30, "_TRIM_PERIOD": 1}.items():
        monkeypatch.setattr(audit_module, name, value)
    log = Audit(tmp_path / "people.sqlite")
    log.close()
    with sqlite3.connect(tmp_path / "people.sqlite") as old:
        add = "INSERT INTO {} (at, what, ref, user, device, address, detail) VALUES (?, ?, '', ?, '', '', '')"
        old.execute(add.format("audit"), (1.0, "drive", "ann"))
        old.executemany(add.format(table), [(2.0 + number, what, "viewer") for number in range(1000)])
    old.close()
    log = Audit(tmp_path / "people.sqlite")
    log.write("reset", user="ann")
    log.close()
    log = Audit(tmp_path / "people.sqlite")
    rows = log.read(2000)
    log.close()
    assert [row.what for row in rows if row.user == "ann"] == ["drive", "reset"]
    assert [row.at for row in rows if row.user == "viewer"] == [1002.0 - number for number in range(left, 0, -1)]


def test_a_database_of_an_older_version_keeps_its_rows(tmp_path: Path) -> None:
    file = tmp_path / "people.sqlite"
    old = sqlite3.connect(file)
    with old:
        old.execute(
            "CREATE TABLE audit (number INTEGER PRIMARY KEY AUTOINCREMENT, at REAL NOT NULL, what TEXT NOT NULL, "
            "ref TEXT NOT NULL, user TEXT NOT NULL, device TEXT NOT NULL, address TEXT NOT NULL, detail TEXT NOT NULL)"
        )
        add = "INSERT INTO audit (at, what, ref, user, device, address, detail) VALUES (?, ?, 'r', 'u', 'd', 'a', 'x')"
        old.executemany(add, [(1.0, "login-refused"), (2.0, "drive")])
    for opened in range(2):
        log = Audit(file)
        log.write("login-refused", user=f"{opened}")
        log.close()
    old.execute("INSERT INTO audit (at, what, ref, user, device, address, detail) VALUES (3, '', '', '', '', '', '')")
    old.commit()  # an older version again
    old.close()
    log = Audit(file)
    rows = log.read(100)
    log.close()
    was = [("login-refused", "r", 1), ("drive", "r", 1), ("", "", 1)]
    assert [(row.what, row.ref, row.count) for row in rows[:3]] == was
    assert [row.what for row in rows[3:]] == ["login-refused"] * 2


def entry(
    what: str, ref: str = "", user: str = "", device: str = "", address: str = "", detail: str = "", at: float = 0.0
) -> Entry:
    return new(at, what, ref, user, device, address, detail)
