"""People, passwords, sessions and the limits of guessing."""

from __future__ import annotations

import hashlib
import os
import sqlite3
import stat
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from pebble.errors import PebbleError
from pebble.extensions.fleet.database import DatabaseError
from pebble.extensions.fleet.people import SESSION_S, People, TooManyTriesError, User, has_user
from pebble.extensions.fleet.roles import Role, page_rights
from pebble.extensions.fleet.tries import TRIES, WINDOW_S, network_of
from tests.support import Clock

PASSWORD = "correct horse"
HERE = "192.0.2.7"


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def people(clock: Clock, cheap_hashes: None) -> Iterator[People]:
    people = People(None, clock=clock, monotonic=clock)
    people.add("alice", PASSWORD, Role.DRIVER)
    yield people
    people.close()


def test_rights_of_each_role() -> None:
    assert {role.value: sorted(page_rights(role)) for role in Role} == {
        "viewer": [],
        "driver": ["drive", "reset"],
        "maintainer": ["drive", "reset", "system", "take"],
        "safety": ["drive", "reset", "take"],
        "admin": ["drive", "people", "reset", "system", "take"],
    }
    assert [role.value for role in Role if "reset" in page_rights(role, "named")] == ["safety", "admin"]


UMLAUT = {"one letter": "Schl\u00fcssel", "two letters, as on macOS": "Schlu\u0308ssel"}


@pytest.mark.parametrize("typed", UMLAUT)
@pytest.mark.parametrize("stored", UMLAUT)
@pytest.mark.parametrize("earlier", [False, True])
def test_a_password_is_right_in_either_spelling_of_its_accents(
    people: People, monkeypatch: pytest.MonkeyPatch, stored: str, typed: str, earlier: bool
) -> None:
    if earlier:  # a version that stored it as it was typed
        monkeypatch.setattr("pebble.extensions.fleet.people.usable", lambda password: password)
    people.set_password("alice", UMLAUT[stored])
    people.add("bob", UMLAUT[stored], Role.VIEWER)
    assert [people.check(name, UMLAUT[typed], HERE) is None for name in ("alice", "bob")] == [False, False]
    assert people.check("alice", "Schlussel", HERE) is None


@pytest.mark.parametrize(
    ("name", "password"),
    [
        ("alice", "wrong horse"),
        ("alice", PASSWORD + "x" * 300),
        ("Alice", PASSWORD),
        ("bob", PASSWORD),
        ("\ud800", "\ud800"),
        ("a" * 100_000, "b" * 100_000),
    ],
)
def test_anything_else_is_refused(people: People, name: str, password: str) -> None:
    assert people.check(name, password, HERE) is None


def test_an_unknown_name_takes_as_long_as_a_known_one() -> None:
    people = People(None)
    people.add("alice", PASSWORD, Role.DRIVER)

    def took(name: str, address: int) -> float:
        start = time.process_time()  # what others do on this machine is not counted
        people.check(name, "wrong horse", f"192.0.2.{address}")
        return time.process_time() - start

    known = min(took("alice", number) for number in range(2))
    unknown = min(took(f"bob{number}", 10 + number) for number in range(2))
    assert unknown > known / 3
    assert known > unknown / 3
    people.close()


def test_five_tries_a_minute_from_one_address(people: People, clock: Clock) -> None:
    for number in range(TRIES):
        assert people.check(f"name{number}", "wrong horse", HERE) is None
    clock.now += 20
    with pytest.raises(TooManyTriesError, match="wait 40 s") as refused:
        people.check("alice", PASSWORD, HERE)
    assert refused.value.wait_s == pytest.approx(40)
    assert people.check("alice", PASSWORD, "192.0.2.8") is not None
    clock.now += WINDOW_S
    assert people.check("alice", PASSWORD, HERE) is not None


@pytest.mark.parametrize("name", ["alice", "unknown"])
def test_five_tries_a_minute_for_one_name(people: People, name: str) -> None:
    for number in range(TRIES):
        assert people.check(name, "wrong horse", f"192.0.2.{number}") is None
    with pytest.raises(TooManyTriesError):
        people.check(name, PASSWORD, "192.0.2.100")


def test_others_cannot_keep_a_person_out_of_an_address_with_a_session(people: People) -> None:
    people.start_session(User("alice", Role.DRIVER), HERE)
    for number in range(TRIES):
        people.check("alice", "wrong horse", f"192.0.2.{100 + number}")
    assert people.check("alice", PASSWORD, HERE) is not None


def test_right_passwords_are_not_limited(people: People) -> None:
    for _ in range(2 * TRIES):
        assert people.check("alice", PASSWORD, HERE) is not None


def test_one_network_of_ipv6_is_one_address(people: People) -> None:
    for number in range(TRIES):
        people.check(f"name{number}", "wrong horse", f"2001:db8:1:2::{number}")
    with pytest.raises(TooManyTriesError):
        people.check("alice", PASSWORD, "2001:db8:1:2:ffff::1")
    assert network_of("2001:db8:1:2::1") != network_of("2001:db8:1:3::1")
    assert network_of("fe80::1%eth0") == network_of("fe80::2%eth0")
    assert network_of("::ffff:192.0.2.1") != network_of("::ffff:192.0.2.2")
    assert network_of("?") == "?"


@pytest.mark.parametrize("name", ["", "Alice", "a" * 33, "anna/drive-values", "ä", "alice\n", "+"])
def test_names_that_could_be_part_of_a_topic_are_refused(people: People, name: str) -> None:
    with pytest.raises(PebbleError, match="is no name"):
        people.add(name, PASSWORD, Role.VIEWER)


@pytest.mark.parametrize("password", ["", "1234567", "x" * 257, "o\u0308" * 7])
def test_the_length_of_a_password(people: People, password: str) -> None:
    with pytest.raises(PebbleError, match="a password has 8 to 256 characters"):
        people.add("bob", password, Role.VIEWER)
    with pytest.raises(PebbleError, match="a password has 8 to 256 characters"):
        people.set_password("alice", password)
    people.set_password("alice", "x" * 256)


def test_names_are_unique_and_must_exist(people: People) -> None:
    with pytest.raises(PebbleError, match="alice exists already"):
        people.add("alice", PASSWORD, Role.VIEWER)
    for change in (
        lambda: people.remove("bob"),
        lambda: people.set_password("bob", PASSWORD),
        lambda: people.set_role("bob", Role.ADMIN),
    ):
        with pytest.raises(PebbleError, match="there is no 'bob'"):
            change()
    assert people.list() == [User("alice", Role.DRIVER)]


def test_a_session_starts_ends_and_expires(people: People, clock: Clock) -> None:
    token = people.start_session(User("alice", Role.DRIVER))
    session = people.session(token)
    assert session is not None
    assert (session.user, session.role) == ("alice", Role.DRIVER)
    assert session.id not in token
    people.set_role("alice", Role.VIEWER)
    changed = people.session(token)
    assert (changed and changed.role) == Role.VIEWER
    people.end_session(token)
    assert people.session(token) is None
    token = people.start_session(User("alice", Role.DRIVER))
    clock.now += SESSION_S - 1
    assert people.session(token) is not None
    clock.now += 1
    assert people.session(token) is None


@pytest.mark.parametrize("token", ["", "\ud800", "' OR 1=1 --", "x" * 100_000])
def test_no_other_token_is_a_session(people: People, token: str) -> None:
    people.start_session(User("alice", Role.DRIVER))
    assert people.session(token) is None


def test_removal_and_a_new_password_end_sessions(people: People) -> None:
    token = people.start_session(User("alice", Role.DRIVER))
    people.set_password("alice", "another horse")
    assert people.session(token) is None
    token = people.start_session(User("alice", Role.DRIVER))
    people.remove("alice")
    people.add("alice", PASSWORD, Role.DRIVER)
    assert people.session(token) is None


def test_the_number_of_sessions_is_bounded(people: People, clock: Clock) -> None:
    tokens = []
    for _ in range(30):
        clock.now += 1
        tokens.append(people.start_session(User("alice", Role.DRIVER)))
    running = [people.session(token) is not None for token in tokens]
    assert running == [False] * 10 + [True] * 20


def test_a_change_by_another_process_counts_at_once(tmp_path: Path) -> None:
    file = tmp_path / "people.sqlite"
    server, command = People(file), People(file)
    command.add("alice", PASSWORD, Role.DRIVER)
    user = server.check("alice", PASSWORD, HERE)
    assert user is not None
    token = server.start_session(user)
    assert command.session(token) is not None
    command.remove("alice")
    assert server.session(token) is None
    server.close()
    command.close()


def test_the_file_is_for_its_owner_and_holds_no_password_and_no_token(tmp_path: Path) -> None:
    file = tmp_path / "new" / "people.sqlite"
    people = People(file)
    people.add("alice", PASSWORD, Role.DRIVER)
    token = people.start_session(User("alice", Role.DRIVER))
    files = sorted(file.parent.iterdir())
    assert [path.name for path in files] == ["people.sqlite", "people.sqlite-shm", "people.sqlite-wal"]
    for path in files:
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert PASSWORD.encode() not in path.read_bytes()
        assert token.encode() not in path.read_bytes()
    people.close()
    with closing(sqlite3.connect(file)) as database:
        ((salt, hashed),) = database.execute("SELECT salt, hash FROM people")
    assert hashed == hashlib.scrypt(PASSWORD.encode(), salt=salt, n=2**14, r=8, p=1)


def test_a_file_that_is_no_database(tmp_path: Path) -> None:
    file = tmp_path / "people.sqlite"
    file.write_text("no database, but long enough to be read as one" * 10)
    with pytest.raises(PebbleError, match=r"people\.sqlite: cannot be used: .*name another file with --people FILE"):
        People(file)
    with pytest.raises(PebbleError, match="below: cannot be used"):
        People(file / "below")


@pytest.mark.parametrize("name", ["people.sqlite", "people.sqlite-journal", "people.sqlite-wal", "people.sqlite-shm"])
def test_a_pipe_in_place_of_a_file_of_the_database_holds_up_nobody(tmp_path: Path, name: str) -> None:
    file = tmp_path / "people.sqlite"
    with closing(People(file)):
        pass
    (tmp_path / name).unlink(missing_ok=True)
    os.mkfifo(tmp_path / name)
    for opens in (People, has_user):
        with pytest.raises(PebbleError, match=f"{name} is no plain file"):
            opens(file)


def test_a_file_that_is_gone_or_replaced_costs_nothing_until_the_next_start(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file, backup = tmp_path / "state" / "people", tmp_path / "people"
    with closing(People(backup)) as others:
        others.add("bob", PASSWORD, Role.VIEWER)
    with closing(People(file)) as people:
        people.add("alice", PASSWORD, Role.DRIVER)
        file.parent.rename(tmp_path / "away")
        assert people.check("alice", PASSWORD, HERE) == User("alice", Role.DRIVER)
        file.parent.mkdir()
        backup.rename(file)
        assert people.check("alice", PASSWORD, HERE) == User("alice", Role.DRIVER)
        assert [record.levelname for record in caplog.records] == ["ERROR"], "once"
        assert "people was removed or replaced: put it back" in caplog.text
        file.rename(backup)
        (tmp_path / "away" / "people").rename(file)
        caplog.set_level("INFO")
        assert people.check("alice", PASSWORD, HERE) == User("alice", Role.DRIVER)
        assert caplog.records[-1].getMessage() == "people, sessions and the audit log are stored again"
        backup.replace(file)
    with closing(People(file)) as people:
        assert people.list() == [User("bob", Role.VIEWER)]


def test_a_folder_that_cannot_be_looked_into_ends_no_session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_file: object) -> None:  # as for other users than root
        raise PermissionError

    with closing(People(tmp_path / "people")) as people:
        people.add("alice", PASSWORD, Role.DRIVER)
        token = people.start_session(User("alice", Role.DRIVER))
        session = people.session(token)
        monkeypatch.setattr("pebble.transports.own_file.identity", refuse)
        assert people.session(token) == session is not None


def test_while_the_file_cannot_be_read_a_session_stays_what_it_was(tmp_path: Path) -> None:
    with closing(People(tmp_path / "people")) as people:
        people.add("alice", PASSWORD, Role.DRIVER)
        token = people.start_session(User("alice", Role.DRIVER))
        session = people.session(token)
        with closing(sqlite3.connect(tmp_path / "people")) as other:
            other.execute("ALTER TABLE sessions RENAME TO away")
            assert people.session(token) == session != people.session("of nobody")
            with pytest.raises(DatabaseError, match="people"):
                people.start_session(User("alice", Role.DRIVER))
            other.execute("ALTER TABLE away RENAME TO sessions")
        assert people.session(token) == session
        people.end_session(token)
        assert people.session(token) is None
        with closing(sqlite3.connect(tmp_path / "people")) as other:
            other.execute("ALTER TABLE sessions RENAME TO away")
        assert people.session(token) is None, "what has ended"


def test_a_look_for_a_person_writes_nothing_and_needs_no_tables(tmp_path: Path) -> None:
    file = tmp_path / "people.sqlite"
    assert (has_user(file), file.exists()) == (False, False)
    file.touch()
    assert (has_user(file), file.stat().st_size) == (False, 0)
    with closing(People(file)) as people:
        assert not has_user(file)
        people.add("ann", "correct horse", Role.ADMIN)
    assert (has_user(file), has_user(file, "ann"), has_user(file, "eve")) == (True, True, False)
