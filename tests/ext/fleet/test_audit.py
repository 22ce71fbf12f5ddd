"""The audit of a page server: what is stored, what strangers can push out, and which tables it takes over."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest

from pebble.extensions.fleet import audit as audit_module
from pebble.extensions.fleet.audit import OTHERS, Audit
from pebble.extensions.fleet.people import People
from pebble.extensions.fleet.row_writer import DIFFERENT, OF_STRANGERS
from tests.support import until


def test_writing_never_blocks_and_what_was_locked_out_is_written(tmp_path: Path) -> None:
    log = Audit(tmp_path / "people.sqlite")
    blocker = sqlite3.connect(tmp_path / "people.sqlite", isolation_level=None)
    blocker.execute("BEGIN IMMEDIATE")
    start = time.monotonic()
    for number in range(3000):
        log.write("flood", ref=f"{number}")
    assert time.monotonic() - start < 1.0
    blocker.execute("ROLLBACK")
    blocker.close()
    log.close()
    rows = Audit(tmp_path / "people.sqlite").read(10_000)
    assert [row.ref for row in rows[:DIFFERENT]] == [f"{number}" for number in range(DIFFERENT)]
    assert [(row.user, row.ref, row.count) for row in rows[DIFFERENT:]] == [
        (OTHERS, "", 1),
        (OTHERS, "", 3000 - DIFFERENT - 1),
    ]


def test_long_and_odd_texts_are_stored() -> None:
    log = Audit(None)
    log.write("x", ref="x" * 100_000, detail="\ud800 '; DROP TABLE audit; --")
    assert until(lambda: log.read(1))
    assert len(log.read(1)[0].ref) == 200
    assert log.read(1)[0].detail == "? '; DROP TABLE audit; --"
    log.close()


def test_who_reads_the_rows_in_another_process_takes_none_away(tmp_path: Path) -> None:
    file = tmp_path / "people.sqlite"
    people, log = People(file), Audit(file)
    for number in range(3):
        log.write("stop", detail=f"{number}")
        assert until(lambda number=number: len(log.read(9)) == number + 1)
        program = f"import sqlite3; print(len(list(sqlite3.connect({str(file)!r}).execute('SELECT * FROM audit'))))"
        seen = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)
        assert int(seen.stdout) == number + 1
    log.close()
    people.close()


def test_the_rows_of_one_robot_and_of_all(tmp_path: Path) -> None:
    log = Audit(tmp_path / "people.sqlite")
    for number, ref in enumerate(("goob", "fred", "all", "", "goob")):
        log.write("stop", ref=ref, detail=f"{number}")
    assert until(lambda: len(log.read(9)) == 5)
    assert [row.detail for row in log.read(9, "goob")] == ["0", "2", "4"]
    assert [row.detail for row in log.read(2, "goob")] == ["2", "4"]
    log.close()


def test_refused_logins_are_one_row_for_each_network(tmp_path: Path) -> None:
    log = Audit(tmp_path / "people.sqlite")
    for number, user in enumerate(("ann", "bob", "ann")):
        log.write("login-refused", user=user, address=f"2001:db8::{number}")
        log.write("login-limited", user=user, address=f"192.0.2.{number}")
        log.write("login", user=user, address=f"2001:db8::{number}")
    for number in range(1000):
        log.write("login-limited", address=f"10.0.{number >> 8}.{number & 255}")
    log.write("drive", user="ann")
    log.close()
    rows = Audit(tmp_path / "people.sqlite").read(1000)
    assert [row.user for row in rows if row.what == "login"] == ["ann", "bob", "ann"]
    assert [(row.user, row.count) for row in rows if row.what == "login-refused"] == [("ann", 1), ("ann", 2)]
    limited = [row.count for row in rows if row.what == "login-limited"]
    assert (len(limited), sum(limited)) == (OF_STRANGERS - 4 + 2, 1003)
    assert [row.user for row in rows if row.what == "drive"] == ["ann"]


def test_refused_logins_push_out_only_their_own_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"MAX_ROWS": 10, "MAX_REFUSED": 5, "_TRIM_PERIOD": 2}.items():
        monkeypatch.setattr(audit_module, name, value)
    log = Audit(tmp_path / "people.sqlite")
    for what in ("drive", "login-refused", "stop"):
        for number in range(7):
            log.write(what, user=what, address=f"10.0.0.{number}", detail=f"{number}")
        assert until(lambda what=what: [row.detail for row in log.read(99) if row.what == what][-1:] == ["6"])
    log.close()
    rows = Audit(tmp_path / "people.sqlite").read(99)
    kept = [("login-refused", "4"), ("login-refused", "5"), ("login-refused", "6")]
    assert [(row.what, row.detail) for row in rows] == [*kept, *(("stop", f"{number}") for number in range(7))]


@pytest.mark.parametrize("refused", [False, True])
def test_the_tables_of_an_older_version_become_one(tmp_path: Path, refused: bool) -> None:
    file = tmp_path / "people.sqlite"
    texts = "ref, user, device, address, detail"
    more = ", count INTEGER NOT NULL DEFAULT 1, last REAL NOT NULL DEFAULT 0" if refused else ""
    with closing(sqlite3.connect(file)) as old, old:
        for table, what in (("audit", "drive"), ("refused", "login-refused"))[: 1 + refused]:
            old.execute(
                f"CREATE TABLE {table} (number INTEGER PRIMARY KEY AUTOINCREMENT, at REAL, what TEXT, {texts}{more})"
            )
            add = f"INSERT INTO {table} (at, what, {texts}) VALUES (?, ?, 'r', 'u', 'd', 'a', 'x')"
            old.executemany(add, [(1.0, what), (3.0, what)])
        old.execute("CREATE TABLE marks (ref TEXT)")
    for _ in range(2):
        log = Audit(file)
        log.write("stop")
        log.close()
    log = Audit(file)
    whats = [(row.what, row.user, row.count) for row in log.read(100)]
    log.close()
    one = [("drive", "u", 1), ("login-refused", "u", 1)][: 1 + refused]
    assert whats == [*one, *one, ("stop", "", 1), ("stop", "", 1)]
    with closing(sqlite3.connect(file)) as database:
        tables = {name for (name,) in database.execute("SELECT name FROM sqlite_schema WHERE type = 'table'")}
    assert tables == {"audit", "sqlite_sequence"}
