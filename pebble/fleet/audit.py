"""The audit log: who did what to which robot, written by a thread of its own."""

import logging
import sqlite3
import threading
import time
from dataclasses import astuple
from pathlib import Path

from pebble.contract.chain import Mark
from pebble.fleet.audit_rows import Entry, Merging, new
from pebble.fleet.database import Database, DatabaseError

log = logging.getLogger(__name__)

MAX_ACTS, MAX_REFUSED = 100_000, 10_000  # rows; beyond, see _TRIM
_ROUND_S = 0.2  # between two transactions: a row that is repeated is not written each time
_TRIM_PERIOD = 1000  # rows between two deletions of old ones
_FIELDS = "at, what, ref, user, device, address, detail, count, last"
_ADDED = {"count": "INTEGER NOT NULL DEFAULT 1", "last": "REAL NOT NULL DEFAULT 0"}  # to the table of older versions
_TABLES = "".join(
    f"CREATE TABLE IF NOT EXISTS {table} ("
    "number INTEGER PRIMARY KEY AUTOINCREMENT, at REAL NOT NULL, what TEXT NOT NULL, ref TEXT NOT NULL, "
    "user TEXT NOT NULL, device TEXT NOT NULL, address TEXT NOT NULL, detail TEXT NOT NULL, "
    + ", ".join(map(" ".join, _ADDED.items()))
    + ");"
    for table in ("audit", "refused")
)
_TABLES += (
    "CREATE TABLE IF NOT EXISTS marks (ref TEXT NOT NULL, chain TEXT NOT NULL, hour INTEGER NOT NULL, "
    "n INTEGER NOT NULL, h TEXT NOT NULL, PRIMARY KEY (ref, chain, hour)) WITHOUT ROWID;"
)
MAX_MARKS = 200  # of a robot's chain
_TRIM_MARKS = """
DELETE FROM marks WHERE (ref, chain, hour) IN (
    SELECT ref, chain, hour FROM (
        SELECT *, ROW_NUMBER() OVER (PARTITION BY ref, chain ORDER BY hour DESC) AS newer FROM marks)
    WHERE newer > ?)
"""
_PUT_MARK = (
    "INSERT INTO marks VALUES (?, ?, ?, ?, ?) ON CONFLICT DO UPDATE SET n = excluded.n, h = excluded.h "
    "WHERE excluded.n > marks.n"
)
#: The oldest of the person with the most rows of a kind: many of one person displace none of another.
_TRIM = """
DELETE FROM {table} WHERE number IN (
    SELECT number FROM (
        SELECT number, ROW_NUMBER() OVER (PARTITION BY what, {who} ORDER BY number DESC) AS newer FROM {table})
    ORDER BY newer DESC, number LIMIT MAX(0, (SELECT COUNT(*) FROM {table}) - ?))
"""


class Audit:
    """Thread-safe. ``write`` never blocks. What anybody can cause is in a table of its own.

    Repeated rows are merged before they wait (:class:`Merging`); rows that do not fit are counted, and the count is
    written later. What robots tell of their own audits is noted beside it, the newest line of each hour, so that none
    can lose the end of its audit unnoticed.
    """

    def __init__(self, path: Path | None) -> None:
        self._database = Database(path, _TABLES, _add_columns)
        self._opened = self._database.opened
        self._lock = threading.Lock()
        self._changed = threading.Condition()  # guards what follows
        self._rows = Merging()
        self._marks: dict[tuple[str, str], Mark] = {}  # that wait
        self._closing = threading.Event()
        self._written = 0
        self._thread = threading.Thread(target=self._run, name="audit", daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        return self._rows.dropped

    def write(
        self,
        what: str,
        *,
        ref: str = "",
        user: str = "",
        device: str = "",
        address: str = "",
        detail: str = "",
        count: int = 1,
    ) -> None:
        entry = new(time.time(), what, ref, user, device, address, detail)
        entry.count = count
        with self._changed:
            self._rows.add(entry, time.monotonic())
            self._changed.notify()

    def note(self, ref: str, chain: str, mark: Mark) -> None:
        """The newest line of a robot's own audit. ``ref`` is of a bounded set."""
        with self._changed:
            self._marks[ref, chain] = mark
            self._changed.notify()

    def marks(self, ref: str, chain: str) -> list[Mark]:
        """What was noted of a robot's audit, the oldest first. Raises DatabaseError."""
        with self._changed:
            waiting = self._marks.get((ref, chain))
        with self._lock:
            rows = self._database.rows("SELECT n, h FROM marks WHERE ref = ? AND chain = ? ORDER BY hour", (ref, chain))
        return [Mark(*row) for row in rows] + ([waiting] if waiting is not None else [])

    def read(self, limit: int) -> list[Entry]:
        """The newest rows of both tables in the order of their first time, the newest last."""
        with self._lock:
            rows = self._database.rows(
                f"SELECT {_FIELDS}, number FROM audit UNION ALL SELECT {_FIELDS}, number FROM refused "  # noqa: S608
                "ORDER BY at DESC, number DESC LIMIT ?",
                (limit,),
            )
        return [Entry(*row) for row in reversed(rows)]

    def close(self) -> None:
        """Write what waits, for at most a few seconds."""
        with self._changed:
            self._closing.set()
            self._changed.notify()
        self._thread.join(7.0)
        if self._thread.is_alive():
            log.error("audit: entries are lost: the disk is too slow")
        with self._lock:
            self._database.close()

    def _run(self) -> None:
        dropped, failed = 0, False
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closing.is_set() or self._rows.waits or self._marks)
                ends, rows = self._closing.is_set(), self._rows.take()
                marks = dict(self._marks)
            error = self._store(rows, marks)
            lost = self.dropped - dropped
            if error is not None and ends and (rows or lost):
                log.error("audit: %d entries are lost: %s", len(rows) + lost, error)
            elif error is not None and not ends and not failed:
                log.error("audit: entries wait to be written: %s", error)
            failed = error is not None
            if not failed and lost:
                dropped += lost
                log.warning("audit: %d entries are lost: too many waited to be written", lost)
                self.write("audit-dropped", count=lost)
                continue
            if ends:
                return
            if failed:
                with self._changed:
                    self._rows.give_back(rows)
            self._closing.wait(_ROUND_S)

    def _store(self, rows: list[Entry], marks: dict[tuple[str, str], Mark]) -> object:
        """All rows or, when this returns why not, none: a full disk must not end the thread."""
        try:
            with self._lock:
                if removed := self._database.removed:
                    return removed
                with self._database.transaction() as connection:
                    if self._database.opened != self._opened:
                        self._opened = self._database.opened
                        self._begin_again(rows)
                    numbers = [self._put(connection, row) for row in rows]
                    hour = int(time.time() // 3600)
                    connection.executemany(_PUT_MARK, [(*of, hour, *mark) for of, mark in marks.items()])
                    self._written += len(rows) + len(marks)
                    if self._written >= _TRIM_PERIOD:
                        self._written = 0
                        connection.execute(_TRIM.format(table="audit", who="user"), (MAX_ACTS,))
                        connection.execute(_TRIM.format(table="refused", who="address"), (MAX_REFUSED,))
                        connection.execute(_TRIM_MARKS, (MAX_MARKS,))
        except (DatabaseError, sqlite3.Error, OSError) as error:
            return error
        for row, number in zip(rows, numbers, strict=True):
            row.number = number
        with self._changed:
            for of, mark in marks.items():
                if self._marks.get(of) == mark:
                    del self._marks[of]
        return None

    def _begin_again(self, rows: list[Entry]) -> None:
        """Another file has taken the place of the one that has the numbers of rows."""
        with self._changed:
            self._rows.begin_again()
        for row in rows:
            row.number = 0

    def _put(self, connection: sqlite3.Connection, row: Entry) -> int:
        table = "refused" if row.refused else "audit"
        if row.number:
            connection.execute(
                f"UPDATE {table} SET user = ?, address = ?, count = ?, last = ? WHERE number = ?",  # noqa: S608
                (row.user, row.address, row.count, row.last, row.number),
            )
            return row.number
        cursor = connection.execute(
            f"INSERT INTO {table} ({_FIELDS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",  # noqa: S608
            astuple(row)[:-1],
        )
        return cursor.lastrowid or 0


def _add_columns(database: sqlite3.Connection) -> None:
    """To a table of an older version: its rows happened once."""
    database.execute("BEGIN IMMEDIATE")  # another process may do the same
    found = {row[1] for row in database.execute("PRAGMA table_info(audit)")}
    for name, kind in _ADDED.items():
        if name not in found:
            database.execute(f"ALTER TABLE audit ADD COLUMN {name} {kind}")
    database.execute("COMMIT")
