"""The people of an operator page, their sessions, and settings of the server, in one SQLite file."""

import hashlib
import hmac
import logging
import secrets
import sqlite3
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any
from unicodedata import normalize

from pebble.contract.names import NAME
from pebble.errors import PebbleError
from pebble.extensions.fleet.database import Database, DatabaseError, require_plain
from pebble.extensions.fleet.roles import Role, Session
from pebble.extensions.fleet.tries import Tries, network_of
from pebble.runtime.as_owner import as_owner
from pebble.runtime.rate_limit import RateLimitedLog
from pebble.transports.bounds import BoundedTable

log = logging.getLogger(__name__)

SESSION_S = 7 * 24 * 3600.0  # a session ends after this long, whether it is used or not
MIN_PASSWORD = 8
MAX_PASSWORD = 256  # longer ones are refused unread: hashing them costs time
_SESSIONS = 1000  # that are remembered for when the file cannot be read
_SESSIONS_EACH = 20  # of one person; the oldest ends when there are more
_TABLES = """
CREATE TABLE IF NOT EXISTS people (name TEXT PRIMARY KEY, role TEXT NOT NULL, salt BLOB NOT NULL, hash BLOB NOT NULL);
CREATE TABLE IF NOT EXISTS sessions (
    digest BLOB PRIMARY KEY, id TEXT NOT NULL, name TEXT NOT NULL REFERENCES people(name) ON DELETE CASCADE,
    address TEXT NOT NULL, started REAL NOT NULL, expires REAL NOT NULL);
CREATE INDEX IF NOT EXISTS sessions_of ON sessions (name, address);
CREATE TABLE IF NOT EXISTS settings (key TEXT PRIMARY KEY, value TEXT NOT NULL);
"""


class TooManyTriesError(PebbleError):
    """An error: too many password tries from one address or for one name. ``wait_s``: seconds until the next."""

    def __init__(self, wait_s: float) -> None:
        self.wait_s = wait_s
        super().__init__(f"too many tries: wait {max(1, round(wait_s))} s")


@dataclass(frozen=True, slots=True)
class User:
    """A person with a role."""

    name: str
    role: Role


class People:
    """The table of people and sessions. Thread-safe. It reads the file on each call: other processes may change it.

    ``path`` None: in memory. Passwords are stored as scrypt hashes, session tokens as their SHA-256.
    """

    def __init__(
        self,
        path: Path | None,
        *,
        clock: Callable[[], float] = time.time,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._lock = threading.Lock()
        self._database = Database(path, _TABLES)
        self._removed = ""  # the error that was logged last, if the file was removed
        self._log = RateLimitedLog(log, period_s=60.0)
        #: By the token's SHA-256: what the file said of the session when it could be read last, and when that session
        #: ends. Only their number is limited: the limit in bytes, 1 KiB for each, is far above a digest in hex.
        self._seen = BoundedTable[tuple[Session, float]](_SESSIONS, 1024 * _SESSIONS, lambda _: 1)
        self._clock = clock
        self._addresses, self._names = Tries(monotonic), Tries(monotonic)  # counts of failed logins
        self._no_hash = _no_hash()  # compared where the name is unknown, so that this takes as long

    def close(self) -> None:
        with self._lock:
            self._database.close()

    # -- people

    def add(self, name: str, password: str, role: Role) -> None:
        """Add a person. Raises PebbleError."""
        self.check_name(name)
        salt = secrets.token_bytes(16)
        values = (name, role.value, salt, _hash(usable(password), salt))
        try:
            self._change("INSERT INTO people (name, role, salt, hash) VALUES (?, ?, ?, ?)", *values)
        except sqlite3.IntegrityError:
            raise _exists(name) from None

    def check_name(self, name: str) -> None:
        """Raise PebbleError for a name that cannot be used."""
        if not NAME.fullmatch(name):
            raise PebbleError(f"{name!r} is no name: use 1 to 32 of a-z, 0-9, _ and -")
        if self._rows("SELECT 1 FROM people WHERE name = ?", name):
            raise _exists(name)

    def remove(self, name: str) -> None:
        """Remove a person and end their sessions. Raises PebbleError."""
        self._change_one(name, "DELETE FROM people WHERE name = ?", name)

    def set_password(self, name: str, password: str) -> None:
        """Change a password and end the person's sessions. Raises PebbleError."""
        salt = secrets.token_bytes(16)
        hashed = _hash(usable(password), salt)
        self._change_one(name, "UPDATE people SET salt = ?, hash = ? WHERE name = ?", salt, hashed, name)
        self._change("DELETE FROM sessions WHERE name = ?", name)

    def set_role(self, name: str, role: Role) -> None:
        """Change a person's role, in running sessions too. Raises PebbleError."""
        self._change_one(name, "UPDATE people SET role = ? WHERE name = ?", role.value, name)

    def list(self) -> list[User]:
        return [User(name, Role(role)) for name, role in self._rows("SELECT name, role FROM people ORDER BY name")]

    def version(self) -> tuple[int, int]:
        """Return numbers that change with people and sessions, by any process. Raises DatabaseError."""
        with self._lock:
            return self._database.version()

    # -- sessions

    def check(self, name: str, password: str, address: str) -> User | None:
        """Return the person with this name and password. Blocks for about 20 ms, 60 with accents.

        It takes as long for unknown names. Raises TooManyTriesError. When a name's tries are used up, it can still log
        in from an address where it has a session, so that others cannot lock a person out.
        """
        self._count_try(name, address)
        looked_up = name if NAME.fullmatch(name) else ""
        rows = self._rows("SELECT name, role, salt, hash FROM people WHERE name = ?", looked_up)
        stored_name, role, salt, expected = rows[0] if rows else ("", "", b"no such person..", self._no_hash)
        typed = password[: 2 * MAX_PASSWORD]  # twice: an accent may be typed as a character beside its letter
        # composed, and as typed, which earlier versions stored
        hashes = [_hash(form, salt) for form in {normalize("NFC", typed), typed, normalize("NFD", typed)}]
        is_right = any(hmac.compare_digest(digest, expected) for digest in hashes)
        if not is_right or not stored_name or len(normalize("NFC", typed)) > MAX_PASSWORD:
            return None
        self._addresses.give_back(network_of(address))
        self._names.give_back(name)
        return User(stored_name, Role(role))

    def start_session(self, user: User, address: str = "") -> str:
        """Start a session; return its token, which is stored nowhere."""
        token = secrets.token_urlsafe(32)
        now = self._clock()
        values = (_digest(token), secrets.token_hex(4), user.name, address, now, now + SESSION_S)
        self._change("DELETE FROM sessions WHERE expires <= ?", now)
        newest = "SELECT digest FROM sessions WHERE name = ? ORDER BY started DESC LIMIT ?"
        others = f"DELETE FROM sessions WHERE name = ? AND digest NOT IN ({newest})"  # noqa: S608
        self._change(others, user.name, user.name, _SESSIONS_EACH - 1)
        self._change(
            "INSERT INTO sessions (digest, id, name, address, started, expires) VALUES (?, ?, ?, ?, ?, ?)", *values
        )
        return token

    def session(self, token: str) -> Session | None:
        """Return the session of this token, with the person's present role; None if there is none.

        While the file cannot be read, the last known answer is returned, so that the driver can continue and stop
        robots.
        """
        digest, now = _digest(token), self._clock()
        try:
            rows = self._rows(
                "SELECT sessions.id, people.name, people.role, expires FROM sessions JOIN people USING (name) "
                "WHERE digest = ? AND expires > ?",
                digest,
                now,
            )
        except DatabaseError as error:
            self._log.log("unreadable", logging.ERROR, "%s: who is logged in stays so until it can be read", error)
            session, expires = self._seen.get(digest.hex(), (None, now))
            return session if expires > now else None
        if not rows:
            self._seen.pop(digest.hex(), None)
            return None
        id_, name, role, expires = rows[0]
        session = Session(id_, name, Role(role))
        self._seen[digest.hex()] = session, expires
        return session

    def end_session(self, token: str) -> None:
        self._change("DELETE FROM sessions WHERE digest = ?", _digest(token))

    # -- settings of the server

    def get(self, key: str) -> str:
        """Return a setting; "" if it was never set."""
        rows = self._rows("SELECT value FROM settings WHERE key = ?", key)
        return str(rows[0][0]) if rows else ""

    def set(self, key: str, value: str) -> None:
        self._change("INSERT OR REPLACE INTO settings (key, value) VALUES (?, ?)", key, value)

    # -- inside

    def _count_try(self, name: str, address: str) -> None:
        wait_s = self._addresses.take(network_of(address))
        if wait_s:
            raise TooManyTriesError(wait_s)
        wait_s = self._names.take(name)
        if wait_s and not self._rows("SELECT 1 FROM sessions WHERE name = ? AND address = ?", name, address):
            raise TooManyTriesError(wait_s)

    def _rows(self, statement: str, *values: Any) -> Sequence[Any]:
        """Return the rows of a statement. Raises DatabaseError, as all methods do."""
        with self._lock:
            self._note_place()
            return self._database.rows(statement, values)

    def _change(self, statement: str, *values: Any) -> int:
        with self._lock:
            self._note_place()
            return self._database.execute(statement, values).rowcount

    def _note_place(self) -> None:
        removed = self._database.removed
        if removed and not self._removed:
            log.error("%s; until then who logs in, and who did what, is not stored", removed)
        elif self._removed and not removed:
            log.info("people, sessions and the audit log are stored again")
        self._removed = removed

    def _change_one(self, name: str, statement: str, *values: Any) -> None:
        if self._change(statement, *values) == 0:
            raise PebbleError(f"there is no {name!r}: `pebble web user list` lists the names")


def _exists(name: str) -> PebbleError:
    return PebbleError(f"{name} exists already: change the password or the role, or remove {name}")


def has_user(path: Path | None, name: str = "") -> bool:
    """True if the database has this person, or, without a name, any person. Raises DatabaseError."""
    if path is None:
        return False
    try:
        with as_owner(path.parent):
            return path.exists() and _has_user(path, name)
    except OSError as error:
        raise DatabaseError(path, error) from None


def _has_user(path: Path, name: str) -> bool:
    """True if the file has this person; with the name "", if it has any person. Raises OSError."""
    require_plain(path)
    # Nothing is written: ``immutable`` keeps SQLite from making its shared-memory file. Beside a write-ahead log, which
    # has to be read, that file is there already.
    unchanged = "" if path.with_name(f"{path.name}-wal").exists() else "&immutable=1"
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro{unchanged}", uri=True)) as connection:
            if not connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'people'").fetchall():
                return False  # the program that made it was killed
            any_or_this = "SELECT 1 FROM people WHERE ? IN (name, '')"  # "": any person
            return bool(connection.execute(any_or_this, (name,)).fetchall())
    except sqlite3.Error as error:
        raise DatabaseError(path, error) from None


def usable(password: str) -> str:
    """Return the password in the form in which it is stored (NFC). Raises PebbleError."""
    password = normalize("NFC", password)
    if not MIN_PASSWORD <= len(password) <= MAX_PASSWORD:
        raise PebbleError(f"a password has {MIN_PASSWORD} to {MAX_PASSWORD} characters")
    return password


@cache
def _no_hash() -> bytes:
    return _hash("", b"no such person..")  # with the salt that :meth:`People.check` takes for an unknown name


def _hash(password: str, salt: bytes) -> bytes:
    return hashlib.scrypt(password.encode(errors="surrogatepass"), salt=salt, n=2**14, r=8, p=1)


def _digest(token: str) -> bytes:
    return hashlib.sha256(token.encode(errors="surrogatepass")).digest()
