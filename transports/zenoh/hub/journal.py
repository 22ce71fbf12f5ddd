"""A database that keeps a hub's records across restarts, and tolerates a disk that fails for a while.

Records survive the death of this process at once. They reach the disk within about a second (``SYNC_S``), which is the
most that a power cut costs.
"""

import logging
import os
import sqlite3
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import closing, suppress
from pathlib import Path

log = logging.getLogger(__name__)

SYNC_S = 1.0
RETRY_S = 30.0  # after a failure of the disk
_NEVER = float("inf")


class Journal:
    """A file of records: call ``load()``, ``rewrite()`` with the current records, then ``put()``, finally ``close()``.

    A disk that is full, missing or read-only is no error for the caller: one line is logged, and ``rewrite_at`` is the
    time to try again. Until then nothing, or only a part, is stored.
    """

    def __init__(self, path: Path, *, clock: Callable[[], float] = time.monotonic) -> None:
        self.path = path
        self.rewrite_at = _NEVER
        self._clock = clock
        self._database: sqlite3.Connection | None = None
        self._loaded = False  # the records of the file are known; until then `rewrite` deletes none
        self._dirty, self._closing = threading.Event(), threading.Event()
        self._syncer = threading.Thread(target=self._sync, name="pebble-journal", daemon=True)

    def load(self) -> list[bytes]:
        """Return the records of the last run, oldest first; none while they cannot be read.

        A damaged file is set aside as ``<path>.bad``.
        """
        try:
            records = [record for (record,) in self._opened().execute("SELECT record FROM records ORDER BY rowid")]
            self._loaded = True
            return records
        except (OSError, sqlite3.OperationalError) as error:
            self._fail(error)
        except sqlite3.DatabaseError as error:
            bad = self.path.with_name(self.path.name + ".bad")
            log.warning("journal %s is damaged (%s): it goes to %s", self.path, error, bad)
            self._release()
            with suppress(OSError):
                self.path.replace(bad)
                for beside in ("-wal", "-shm"):
                    self.path.with_name(self.path.name + beside).unlink(missing_ok=True)
        return []

    def rewrite(self, records: Iterable[tuple[str, bytes]]) -> None:
        """Replace everything in the file by these records, given by their names: all of them, or none."""
        self._release()
        try:
            database = self._opened()
            with database:
                database.execute("BEGIN")
                if self._loaded:
                    database.execute("DELETE FROM records")
                database.executemany("REPLACE INTO records VALUES (?, ?)", records)
        except (OSError, sqlite3.Error) as error:
            self._fail(error)
            return
        if self.rewrite_at != _NEVER:
            log.info("journal %s is written again", self.path)
        self.rewrite_at = _NEVER
        self._dirty.set()
        if not self._syncer.is_alive():
            self._syncer.start()

    def put(self, name: str, record: bytes | None) -> None:
        """Store a record under this name instead of the earlier one; None removes it."""
        if self._database is None:
            return
        try:
            if record is None:
                self._database.execute("DELETE FROM records WHERE name = ?", (name,))
            else:
                self._database.execute("REPLACE INTO records VALUES (?, ?)", (name, record))
        except sqlite3.Error as error:
            self._fail(error)
        self._dirty.set()

    def close(self) -> None:
        self._closing.set()
        self._dirty.set()
        if self._syncer.is_alive():
            self._syncer.join()
        self._release()

    def _opened(self) -> sqlite3.Connection:
        """Return the open database, readable for this user alone. Raises OSError and sqlite3.Error."""
        if self._database is None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            os.close(os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600))
            self._database = sqlite3.connect(self.path, isolation_level=None, check_same_thread=False)
            # No automatic checkpoints: they would sync to disk in `put`. `_sync` makes them.
            for pragma in ("journal_mode = WAL", "synchronous = NORMAL", "wal_autocheckpoint = 0"):
                self._database.execute(f"PRAGMA {pragma}")
            self._database.execute("CREATE TABLE IF NOT EXISTS records (name TEXT PRIMARY KEY, record BLOB)")
        return self._database

    def _release(self) -> None:
        if self._database is not None:
            self._database.close()
            self._database = None

    def _fail(self, error: Exception) -> None:
        """Arrange another attempt later, and log the failure once."""
        if self.rewrite_at == _NEVER:
            log.error(
                "journal %s: %s; a restart of the hub loses retained messages; tried again every %.0f s",
                self.path,
                error.strerror if isinstance(error, OSError) else error,
                RETRY_S,
            )
        self.rewrite_at = self._clock() + RETRY_S

    def _sync(self) -> None:
        """Sync to disk on a thread of its own, because a slow SD card must not delay ``put``."""
        while not self._closing.is_set():
            self._dirty.wait()
            self._closing.wait(SYNC_S)
            self._dirty.clear()
            try:
                with closing(sqlite3.connect(f"{self.path.absolute().as_uri()}?mode=rw", uri=True)) as database:
                    database.execute("PRAGMA wal_checkpoint")
            except sqlite3.Error as error:
                self._fail(error)
