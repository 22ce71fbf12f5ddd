"""Opens the SQLite file of people, sessions and the audit log."""

from __future__ import annotations

import os
import sqlite3
from pathlib import Path

from pebble.errors import PebbleError

_BUSY_S = 5.0  # another process may be writing


def open_database(path: Path | None, tables: str) -> sqlite3.Connection:
    """A connection for use under a lock, each statement a transaction. ``path`` None: in memory. Raises PebbleError.

    A new file, and what SQLite writes beside it, may be read by its owner only.
    """
    try:
        if path is not None:
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            os.close(os.open(path, os.O_RDWR | os.O_CREAT, 0o600))
            path.chmod(0o600)
        where = ":memory:" if path is None else str(path)
        database = sqlite3.connect(where, timeout=_BUSY_S, isolation_level=None, check_same_thread=False)
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("PRAGMA synchronous = NORMAL")
        database.execute("PRAGMA foreign_keys = ON")
        database.executescript(tables)
    except (OSError, sqlite3.Error) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise PebbleError(f"{path}: cannot be used: {why}; name another file with --people FILE") from None
    return database
