"""The audit log: who did what to which robot, written by a thread of its own."""

from __future__ import annotations

import logging
import queue
import sqlite3
import threading
import time
from dataclasses import astuple, dataclass
from pathlib import Path

from pebble.fleet.database import open_database

log = logging.getLogger(__name__)

MAX_ENTRIES = 100_000  # the oldest are deleted beyond that
_WAITING = 1000
_MAX_TEXT = 200
_TRIM_PERIOD = 1000  # entries between two deletions of old ones
_TABLES = """
CREATE TABLE IF NOT EXISTS audit (
    number INTEGER PRIMARY KEY AUTOINCREMENT, at REAL NOT NULL, what TEXT NOT NULL, ref TEXT NOT NULL,
    user TEXT NOT NULL, device TEXT NOT NULL, address TEXT NOT NULL, detail TEXT NOT NULL);
"""


@dataclass(frozen=True, slots=True)
class Entry:
    """One line of the audit log; ``at`` is epoch seconds."""

    at: float
    what: str
    ref: str
    user: str
    device: str
    address: str
    detail: str


class Audit:
    """Thread-safe. ``write`` never blocks; entries that do not fit are counted, and the count is written later."""

    def __init__(self, path: Path | None) -> None:
        self._database = open_database(path, _TABLES)
        self._lock = threading.Lock()
        self._waiting: queue.Queue[Entry | None] = queue.Queue(_WAITING)
        self.dropped = 0
        self._written = 0
        self._thread = threading.Thread(target=self._run, name="audit", daemon=True)
        self._thread.start()

    def write(
        self, what: str, *, ref: str = "", user: str = "", device: str = "", address: str = "", detail: str = ""
    ) -> None:
        texts = (_storable(text) for text in (what, ref, user, device, address, detail))
        try:
            self._waiting.put_nowait(Entry(time.time(), *texts))
        except queue.Full:
            self.dropped += 1

    def read(self, limit: int) -> list[Entry]:
        """The newest entries, the newest last."""
        with self._lock:
            rows = self._database.execute(
                "SELECT at, what, ref, user, device, address, detail FROM audit ORDER BY number DESC LIMIT ?", (limit,)
            ).fetchall()
        return [Entry(*row) for row in reversed(rows)]

    def close(self) -> None:
        """Write what waits, for at most a few seconds."""
        try:
            self._waiting.put(None, timeout=2.0)
        except queue.Full:
            log.error("audit: entries are lost: the disk is too slow")
        self._thread.join(5.0)
        with self._lock:
            self._database.close()

    def _run(self) -> None:
        dropped = 0
        while (entry := self._waiting.get()) is not None:
            self._insert(entry)
            if self.dropped != dropped:
                lost, dropped = self.dropped - dropped, self.dropped
                self._insert(Entry(time.time(), "audit-dropped", "", "", "", "", f"{lost} entries"))

    def _insert(self, entry: Entry) -> None:
        try:
            with self._lock:
                self._database.execute(
                    "INSERT INTO audit (at, what, ref, user, device, address, detail) VALUES (?, ?, ?, ?, ?, ?, ?)",
                    astuple(entry),
                )
                self._written += 1
                if self._written % _TRIM_PERIOD == 0:
                    self._database.execute(
                        "DELETE FROM audit WHERE number <= (SELECT MAX(number) FROM audit) - ?", (MAX_ENTRIES,)
                    )
        except sqlite3.Error as error:  # a full disk must not end the thread
            log.error("audit: an entry is lost: %s", error)


def _storable(text: str) -> str:
    return text[:_MAX_TEXT].encode(errors="replace").decode()
