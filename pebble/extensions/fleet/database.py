"""The SQLite file with people, sessions and the audit."""

import errno
import os
import sqlite3
import stat
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from pebble.errors import PebbleError
from pebble.runtime.as_owner import require_own
from pebble.runtime.whole_file import set_mode
from pebble.transports.own_file import OwnFile

_BUSY_S = 5.0  # another process may be writing


class DatabaseError(PebbleError):
    """An error: a file cannot be read or written now. Example: ``people.sqlite: database or disk is full``."""

    def __init__(self, path: Path | None, error: Exception) -> None:
        self.why = (error.strerror or str(error)) if isinstance(error, OSError) else str(error)
        super().__init__(f"{path}: {self.why}")


class Database:
    """A connection to a SQLite file, used under a lock; each statement is a transaction.

    ``path`` None: in memory. If the file is removed or replaced, the connection continues with the file that it opened.
    A new file, and what SQLite writes beside it, is readable only by its owner. Raises PebbleError if it cannot be
    opened; ``upgrade`` changes the tables of older versions.
    """

    def __init__(
        self, path: Path | None, tables: str, upgrade: Callable[[sqlite3.Connection], None] = lambda _connection: None
    ) -> None:
        self._path = path
        if path is not None:
            require_own(path.parent)
        try:
            if path is not None:
                path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                require_own(path.parent)  # another user may have been faster
                if not path.exists():
                    os.close(os.open(path, os.O_RDWR | os.O_CREAT, 0o600))
            self._connection = _connection(path, tables)
            upgrade(self._connection)
            self._own = None if path is None else OwnFile(path)
        except (OSError, sqlite3.Error) as error:
            why = DatabaseError(path, error).why.replace("is locked", "is locked, or its file system has no locks")
            raise PebbleError(f"{path}: cannot be used: {why}; name another file with --people FILE") from None

    @property
    def removed(self) -> str:
        """Return an error text if the file was removed or replaced; else empty."""
        with suppress(OSError):  # what is there cannot be seen: the connection goes on with the file that it opened
            if self._own is not None and not self._own.in_place:
                return f"{self._path} was removed or replaced: put it back, or start the page again"
        return ""

    def rows(self, statement: str, values: Sequence[Any] = ()) -> list[Any]:
        """Return the rows that a statement yields. Raises DatabaseError."""
        with self._errors():
            return self._connection.execute(statement, values).fetchall()

    def execute(self, statement: str, values: Sequence[Any] = ()) -> sqlite3.Cursor:
        """Execute a statement that changes something.

        Raises DatabaseError, and IntegrityError for what the tables forbid.
        """
        with self._errors():
            return self._connection.execute(statement, values)

    def version(self) -> tuple[int, int]:
        """Return numbers that differ after each change by any process. Raises DatabaseError."""
        with self._errors():
            (by_others,) = self._connection.execute("PRAGMA data_version").fetchone()
            return by_others, self._connection.total_changes

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.IntegrityError:  # for the caller
            raise
        except (OSError, sqlite3.Error) as error:
            raise DatabaseError(self._path, error) from None

    @contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """Execute the statements of the block together: all of them, or none if one raises. Raises DatabaseError."""
        with self._errors():
            connection = self._connection
            connection.execute("BEGIN IMMEDIATE")
            try:
                yield connection
                connection.execute("COMMIT")
            except BaseException:
                connection.rollback()  # a full disk may have done so
                raise

    def close(self) -> None:
        self._connection.close()


def require_plain(database: Path) -> None:
    """Raise OSError if a file of a database is a FIFO, for which SQLite would wait for ever, a device or a folder."""
    for file in (database.with_name(f"{database.name}{end}") for end in ("", "-journal", "-wal", "-shm")):
        # Not opened: when a process closes a file, it loses the locks of all its connections.
        with suppress(FileNotFoundError):
            if not stat.S_ISREG(file.stat().st_mode):
                raise OSError(errno.EINVAL, f"{file.name} is no plain file", str(file))


def _connection(path: Path | None, tables: str) -> sqlite3.Connection:
    """Open the file, which exists already, and create missing tables. Raises OSError and sqlite3.Error."""
    if path is not None:
        require_plain(path)
        set_mode(path, 0o600)
    where = ":memory:" if path is None else str(path)
    connection = sqlite3.connect(where, timeout=_BUSY_S, isolation_level=None, check_same_thread=False)
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA synchronous = NORMAL")
    connection.execute("PRAGMA foreign_keys = ON")
    connection.executescript(tables)
    return connection
