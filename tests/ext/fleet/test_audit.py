"""The audit of a page server, and the writer of rows behind it and the robot's.

Which rows are one, what strangers can push out, and what a store that takes nothing does to them.
"""

from __future__ import annotations

import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from pebble.extensions.fleet import audit as audit_module
from pebble.extensions.fleet import row_writer
from pebble.extensions.fleet.audit import OTHERS, Audit
from pebble.extensions.fleet.people import People
from pebble.extensions.fleet.row_writer import DIFFERENT, OF_STRANGERS, WAITING, WINDOW_S, RowWriter
from tests.support import WAIT_S, quickly, until


def test_writing_never_blocks_and_what_was_locked_out_is_written(tmp_path: Path) -> None:
    log = Audit(tmp_path / "people.sqlite")
    blocker = sqlite3.connect(tmp_path / "people.sqlite", isolation_level=None)
    blocker.execute("BEGIN IMMEDIATE")
    with quickly():
        for number in range(DIFFERENT + 3):
            log.write("flood", ref=f"{number}")
    blocker.execute("ROLLBACK")
    blocker.close()
    log.close()
    rows = Audit(tmp_path / "people.sqlite").read(10_000)
    assert [row.ref for row in rows[:DIFFERENT]] == [f"{number}" for number in range(DIFFERENT)]
    assert [(row.user, row.ref, row.count) for row in rows[DIFFERENT:]] == [(OTHERS, "", 1), (OTHERS, "", 2)]


def test_who_reads_the_rows_in_another_process_takes_none_away(tmp_path: Path) -> None:
    file = tmp_path / "people.sqlite"
    people, log = People(file), Audit(file)
    program = f"import sqlite3; print(len(list(sqlite3.connect({str(file)!r}).execute('SELECT * FROM audit'))))"
    for number in (1, 2):
        log.write("stop", detail=f"{number}")
        assert until(lambda number=number: len(log.read(9)) == number)
        seen = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)
        assert int(seen.stdout) == number
    log.close()
    people.close()


def test_the_rows_of_one_robot_and_of_all(tmp_path: Path) -> None:
    log = Audit(tmp_path / "people.sqlite")
    for ref, detail in (("goob", "0"), ("fred", "1"), ("all", "2"), ("", "3"), ("goob", "\ud800 '; DROP TABLE audit")):
        log.write("stop", ref=ref, detail=detail)
    assert until(lambda: len(log.read(9)) == 5)
    assert [row.detail for row in log.read(9, "goob")] == ["0", "2", "? '; DROP TABLE audit"]
    assert [row.detail for row in log.read(1, "goob")] == ["? '; DROP TABLE audit"]
    log.write("stop", ref="x" * 100_000)
    assert until(lambda: len(log.read(9)) == 6)
    assert len(log.read(1)[0].ref) == 200
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


def test_the_tables_of_an_older_version_become_one(tmp_path: Path) -> None:
    file = tmp_path / "people.sqlite"
    texts = "ref, user, device, address, detail"
    columns = f"number INTEGER PRIMARY KEY AUTOINCREMENT, at REAL, what TEXT, {texts}"
    counts = ", count INTEGER NOT NULL DEFAULT 1, last REAL NOT NULL DEFAULT 0"
    with closing(sqlite3.connect(file)) as old, old:
        for table, what, more in (("audit", "drive", ""), ("refused", "login-refused", counts)):
            old.execute(f"CREATE TABLE {table} ({columns}{more})")
            add = f"INSERT INTO {table} (at, what, {texts}) VALUES (?, ?, 'r', 'u', 'd', 'a', 'x')"
            old.executemany(add, [(1.0, what), (3.0, what)])
    for _ in range(2):
        log = Audit(file)
        log.write("stop")
        log.close()
    rows = [(row.what, row.user, row.count) for row in Audit(file).read(100)]
    assert rows == [("drive", "u", 1), ("login-refused", "u", 1)] * 2 + [("stop", "", 1)] * 2


class Store:
    """Keeps rows, unless it is told to fail or to wait; the writer's clock stands still."""

    def __init__(self) -> None:
        self.now, self.rows, self.fails = 1000.0, list[dict[str, Any]](), False
        self.may_go = threading.Event()
        self.may_go.set()
        self.writer = RowWriter(self.store, lambda: self.now)
        self.writer.start()

    def store(self, rows: list[dict[str, Any]]) -> None:
        self.may_go.wait(WAIT_S)
        if self.fails:
            raise OSError(28, "No space left on device")
        self.rows += rows

    def add(self, what: str, number: int = 0, **options: Any) -> None:
        self.writer.add({"t": self.now, "what": what, "number": number}, **options)

    def end(self) -> list[tuple[str, Any, int]]:
        """What is stored at the end: kind, number and count of each row."""
        self.writer.close()
        return [(row["what"], row.get("number"), row.get("count", 1)) for row in self.rows]


@pytest.fixture
def store(monkeypatch: pytest.MonkeyPatch) -> Iterator[Store]:
    monkeypatch.setattr(row_writer, "_ROUND_S", 0.02)
    one = Store()
    yield one
    one.may_go.set()
    one.writer.close()


def test_alike_rows_of_a_minute_are_one_and_another_with_their_number(store: Store) -> None:
    for after_s in (0, WINDOW_S - 1, WINDOW_S - 0.5):
        store.now = 1000.0 + after_s
        store.add("stop", 7)
        store.add("reset", 1 if after_s else 0)
    store.now = 1000.0 + WINDOW_S
    store.add("stop", 7)
    once = [("stop", 7, 1), ("reset", 0, 1), ("reset", 1, 1)]
    assert store.end() == [*once, ("stop", 7, 2), ("reset", 1, 1), ("stop", 7, 1)]
    assert [row["t"] - 1000 for row in store.rows if "count" in row] == [WINDOW_S - 0.5] * 2


def test_what_was_counted_is_stored_when_nothing_comes_after_it(store: Store) -> None:
    for _ in range(3):
        store.add("stop")
    assert until(lambda: len(store.rows) == 1)
    store.now += WINDOW_S - 0.1
    time.sleep(0.05)  # for some rounds nothing is due
    assert len(store.rows) == 1
    store.now += 0.1
    assert until(lambda: store.rows[1:] == [{"t": 1000.0, "what": "stop", "number": 0, "count": 2}])


def test_rows_that_differ_too_much_are_counted_by_their_kind(store: Store) -> None:
    for number in range(DIFFERENT + 3):
        store.add("stop", number)
    store.add("reset")
    store.add("stop", 0)
    stored = store.end()
    assert stored[:DIFFERENT] == [("stop", number, 1) for number in range(DIFFERENT)]
    assert stored[DIFFERENT:] == [("stop", None, 1), ("reset", None, 1), ("stop", 0, 1), ("stop", None, 2)]


def test_strangers_leave_room_for_others(store: Store) -> None:
    for number in range(5):
        store.add("refused", number, most=2)
    store.add("refused", 9, like="the first of many", most=10)
    for _ in range(2):
        store.add("refused", 8, like="the first of many", most=2)
    store.add("stop", 7)
    kept = [("refused", 0, 1), ("refused", 1, 1), ("refused", None, 1), ("refused", 9, 1), ("stop", 7, 1)]
    assert store.end() == [*kept, ("refused", None, 2), ("refused", 8, 2)]


def test_a_store_that_takes_nothing_is_said_once_and_loses_no_row(
    store: Store, caplog: pytest.LogCaptureFixture
) -> None:
    store.fails = True
    for number in range(3):
        store.add("stop", number)
    assert until(lambda: "rows wait to be written" in caplog.text)
    time.sleep(0.1)  # for some rounds
    store.fails = False
    store.add("stop", 3)
    assert store.end() == [("stop", number, 1) for number in range(4)]
    assert [record.message for record in caplog.records if "audit" in record.message] == [
        "audit: rows wait to be written: [Errno 28] No space left on device",
        "audit: rows are written again, 0 are lost",
    ]


def test_who_adds_a_row_never_waits_and_what_finds_no_room_is_counted(
    store: Store, caplog: pytest.LogCaptureFixture
) -> None:
    store.may_go.clear()
    with quickly():
        for number in range(2 * WAITING):
            store.now += WINDOW_S / DIFFERENT  # so that all may be stored
            store.add("stop", number)
    store.fails = True
    store.may_go.set()
    assert until(lambda: "rows wait to be written" in caplog.text)
    store.fails = False
    stored = store.end()
    assert stored == [*(("stop", number, 1) for number in range(WAITING)), ("audit-dropped", None, WAITING)]
    assert f"audit: rows are written again, {WAITING} are lost" in caplog.text
    assert "audit: 1" not in caplog.text


@pytest.mark.parametrize(("rows", "step_s"), [(3, 0.0), (WAITING + 5, WINDOW_S / DIFFERENT)])
def test_rows_that_cannot_be_stored_at_the_end_are_counted(
    store: Store, caplog: pytest.LogCaptureFixture, rows: int, step_s: float
) -> None:
    store.fails = True
    for number in range(rows):
        store.now += step_s
        store.add("stop", number if step_s else 0)
    assert store.end() == []
    assert f"audit: {rows} rows are lost" in caplog.text
