"""The audit of a page server, as one table: who did what to which robot."""

import sqlite3
import threading
import time
from pathlib import Path
from typing import Final

from msgspec import Struct

from pebble.extensions.fleet.database import Database
from pebble.extensions.fleet.row_writer import DIFFERENT, OF_STRANGERS, Row, RowWriter
from pebble.extensions.fleet.tries import network_of

#: What anybody can cause, without a right and without a login.
REFUSED: Final = ("login-refused", "login-limited")
#: What many pages may ask of many robots at once. Its rows take no room that others need.
MILD: Final = ("lights", "soundboard")
OTHERS = "(others)"
MAX_ROWS, MAX_REFUSED = 100_000, 10_000  # of all, and of REFUSED; beyond, the oldest go
_TRIM_PERIOD = 1000  # rows between two deletions of old ones
_MAX_TEXT = 200  # characters of one value
_FIELDS = ("ref", "user", "device", "address", "detail")
_COLUMNS = ", ".join(("at", "what", *_FIELDS, "count"))
_TABLES = (
    "CREATE TABLE IF NOT EXISTS audit ("
    "number INTEGER PRIMARY KEY AUTOINCREMENT, at REAL NOT NULL, what TEXT NOT NULL, ref TEXT NOT NULL, "
    "user TEXT NOT NULL, device TEXT NOT NULL, address TEXT NOT NULL, detail TEXT NOT NULL, "
    "count INTEGER NOT NULL DEFAULT 1);"
)
_TRIM = """
DELETE FROM audit WHERE number IN (
    SELECT number FROM audit WHERE what IN (?, ?) ORDER BY number DESC LIMIT -1 OFFSET ?
) OR number IN (SELECT number FROM audit ORDER BY number DESC LIMIT -1 OFFSET ?)
"""


class Entry(Struct, frozen=True):
    """A row of the audit. ``at``: epoch seconds. ``count``: how many more rows of the same minute it stands for."""

    at: float
    what: str
    ref: str
    user: str
    device: str
    address: str
    detail: str
    count: int


class Audit:
    """The audit log of a page server. Thread-safe; :meth:`write` never blocks."""

    def __init__(self, path: Path | None) -> None:
        self._database = Database(path, _TABLES, _take_over)
        self._lock = threading.Lock()
        self._written = 0
        self._writer = RowWriter(self._store)
        self._writer.start()

    def write(
        self, what: str, *, ref: str = "", user: str = "", device: str = "", address: str = "", detail: str = ""
    ) -> None:
        """Add a row, or only count it if a similar one was added in this minute (`RowWriter.add`).

        What strangers, or many pages at once, may cause has fewer different rows a minute: at most OF_STRANGERS.
        """
        fields = zip(_FIELDS, (ref, user, device, address, detail), strict=True)
        texts = {field: text[:_MAX_TEXT].encode(errors="replace").decode() for field, text in fields}
        refused = what in REFUSED
        shared_key = (what, network_of(address)) if refused else None  # refusals of one network share a row
        most_different = OF_STRANGERS if refused or what in MILD else DIFFERENT
        self._writer.add({"t": time.time(), "what": what, **texts}, shared_key, most_different)

    def read(self, limit: int, ref: str = "") -> list[Entry]:
        """Return the newest rows, the newest last. ``ref``: those of one robot and of all robots.

        Raises DatabaseError.
        """
        with self._lock:
            rows = self._database.rows(
                f"SELECT {_COLUMNS} FROM audit WHERE ? IN ('', ref) OR ref = 'all' "  # noqa: S608
                "ORDER BY at DESC, number DESC LIMIT ?",
                (ref, limit),
            )
        return [Entry(*row) for row in reversed(rows)]

    def close(self) -> None:
        """Write the waiting rows, for a few seconds at most."""
        self._writer.close()
        with self._lock:
            self._database.close()

    def _store(self, rows: list[Row]) -> None:
        """Store all rows, or none: then it raises DatabaseError or OSError."""
        with self._lock:
            if removed := self._database.removed:
                raise OSError(removed)
            self._written += len(rows)
            with self._database.transaction() as connection:
                connection.executemany(
                    f"INSERT INTO audit ({_COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?)",  # noqa: S608
                    [_values(row) for row in rows],
                )
                if self._written >= _TRIM_PERIOD:
                    self._written = 0
                    connection.execute(_TRIM, (*REFUSED, MAX_REFUSED, MAX_ROWS))


def _values(row: Row) -> tuple[float | str | int, ...]:
    """Return the values of a row in their stored form.

    In a flood, one row without a user counts all further rows of a kind: OTHERS is stored as its user.
    """
    texts = (row.get(field, OTHERS if field == "user" else "") for field in _FIELDS)
    return (row["t"], row["what"], *texts, row.get("count", 1))


def _take_over(database: sqlite3.Connection) -> None:
    """Move the rows of an older version's tables into the present one."""
    database.execute("BEGIN IMMEDIATE")  # another process may do the same
    if "count" not in {row[1] for row in database.execute("PRAGMA table_info(audit)")}:
        database.execute("ALTER TABLE audit ADD COLUMN count INTEGER NOT NULL DEFAULT 1")
    if list(database.execute("PRAGMA table_info(refused)")):
        database.execute(f"INSERT INTO audit ({_COLUMNS}) SELECT {_COLUMNS} FROM refused")  # noqa: S608
        database.execute("DROP TABLE refused")
    database.execute("DROP TABLE IF EXISTS marks")  # what it noted of robots' own audits
    database.execute("COMMIT")
