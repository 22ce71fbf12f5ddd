"""The audits of a page server and of a robot, and the writer of rows behind them.

What becomes a row, which rows are one, what strangers can push out, and what a store that takes nothing does to them.
"""

from __future__ import annotations

import json
import os
import sqlite3
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from pebble.contract import AUTONOMY_COMMAND, CONTROL_TAKE, DRIVE, ESTOP, ESTOP_RESET, codec
from pebble.contract import channels as c
from pebble.extensions.fleet import audit as audit_module
from pebble.extensions.fleet import robot_audit, row_writer
from pebble.extensions.fleet.audit import OTHERS, Audit
from pebble.extensions.fleet.people import People
from pebble.extensions.fleet.robot_audit import ROBOT, files
from pebble.extensions.fleet.robot_audit import Audit as RobotAudit
from pebble.extensions.fleet.row_writer import DIFFERENT, OF_STRANGERS, WAITING, WINDOW_S, RowWriter
from pebble.forwarding.routing import Drop
from tests.ext.operator.client.estop_robot import estop_state
from tests.services.mqtt_bridge.bridge_rig import make_config
from tests.support import WAIT_S, quickly, until


def test_writing_never_blocks_and_what_was_locked_out_is_written(tmp_path: Path) -> None:
    log = Audit(tmp_path / "people.sqlite")
    blocker = sqlite3.connect(tmp_path / "people.sqlite", isolation_level=None)
    blocker.execute("BEGIN IMMEDIATE")
    with quickly(2.5):
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


# -- the audit of a robot


STOP = "0123456789abcdef"
ID = "0000000a"
SCRIPT = {"file": "f" * 80, "enabled": True, "config": {"password": "sentinel"}, "by": "ann"}
DISK_IS_FULL = "No space left on device"


class Log:
    """An audit with a folder of its own, and its rows but for their times."""

    def __init__(self, *owners: str) -> None:
        config = replace(make_config(), motor_owners=owners)
        self.path, self.older = files(config)
        self.now = 0.0
        self.audit = RobotAudit(config, lambda: self.now)
        self.audit.start()

    def send(self, channel: c.Channel, sender: str | None, **payload: Any) -> None:
        self.audit.passed(channel, sender, json.dumps(payload).encode())

    def control(self, **state: Any) -> None:
        whole = {"by": "", "id": "", "key": "", "boot": "b", "named": True, **state}
        self.audit.control(codec.decode(c.CONTROL_STATE, json.dumps(whole).encode()))

    def rows(self) -> list[dict[str, Any]]:
        """All rows in the end, without the first one."""
        self.audit.close()
        rows = [json.loads(line) for line in self.path.read_bytes().splitlines()]
        assert all(row.pop("t") > 1.7e9 for row in rows)
        return rows[1:]


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Log]:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    one = Log()
    yield one
    one.audit.close()


OUTSIDE, INSIDE = {"from": "operators"}, {"from": "robot"}
# fmt: off
ROWS: dict[str, tuple[c.Channel, str | None, dict[str, Any], dict[str, Any] | None]] = {
    "a stop": (ESTOP, "ann", {"stop": STOP, "why": "cat"},
               {"what": "stop", "who": "ann", **OUTSIDE, "stop": STOP, "why": "cat"}),
    "of who claims a name": (ESTOP, "-", {"by": "Ann?", "why": "w" * 80},
                             {"what": "stop", "who": "ann?", **OUTSIDE, "stop": "", "why": "w" * 40}),
    "of who has none": (ESTOP, None, {}, {"what": "stop", "who": "?", **OUTSIDE, "stop": "", "why": ""}),
    "of the robot": (ESTOP, ROBOT, {"by": "b" * 32},
                     {"what": "stop", "who": f"{ROBOT}/{'b' * 32}", **INSIDE, "stop": "", "why": ""}),
    "a reset": (ESTOP_RESET, "page-1/ann", {"boot": "b", "count": 1},
                {"what": "reset", "who": "page-1/ann", **OUTSIDE}),
    "control is demanded": (CONTROL_TAKE, None, {"id": ID, "by": "otto"},
                            {"what": "control-demanded", "who": "otto?", **OUTSIDE, "id": ID}),
    "and released": (c.CONTROL, "otto", {"id": ID, "want": "release"},
                     {"what": "control-released", "who": "otto", **OUTSIDE, "id": ID}),
    "a script, without its settings": (AUTONOMY_COMMAND, "ann", SCRIPT,
                                       {"what": "script-start", "who": "ann", **OUTSIDE, "file": "f" * 64}),
    "its end": (AUTONOMY_COMMAND, ROBOT, {"action": "stop"},
                {"what": "script-stop", "who": ROBOT, **INSIDE, "file": ""}),
    "an action": (c.REBOOT, "ann", {"value": True},
                  {"what": "action", "who": "ann", **OUTSIDE, "name": "reboot", "on": True}),
    "a flag": (c.MQTT_VIDEO, "ann", {"value": False},
               {"what": "flag", "who": "ann", **OUTSIDE, "name": "mqtt-video", "on": False}),
    "an action that is switched off": (c.REBOOT, "ann", {"value": False}, None),
    "a wish for control": (c.CONTROL, "ann", {"id": ID}, None),
    "a sound": (c.SOUNDBOARD_COMMAND, "ann", {"action": "play", "file": "horn.wav", "repeat": 3},
                {"what": "sound-start", "who": "ann", **OUTSIDE, "file": "horn.wav"}),
    "its end, too": (c.SOUNDBOARD_COMMAND, None, {"enabled": False},
                     {"what": "sound-stop", "who": "?", **OUTSIDE, "file": ""}),
    "a light": (c.LIGHTS_FLASH, "ann", {"r": 0.2, "period": 1},
                {"what": "lights", "who": "ann", **OUTSIDE, "on": True}),
    "a light that goes out": (c.LIGHTS_SOLID, ROBOT, {"r": 0, "g": 0, "b": 0},
                              {"what": "lights", "who": ROBOT, **INSIDE, "on": False}),
    "an outlet": (c.OUTLET_COMMAND, "ann", {"on": True}, {"what": "outlet", "who": "ann", **OUTSIDE, "on": True}),
    "a light in a group": (c.GROUP, "ann", {"drive-values": {"x": 1}, "lights-solid": {"g": 1}},
                           {"what": "lights", "who": "ann", **OUTSIDE, "on": True}),
    "a group that cannot be read": (c.GROUP, "ann", {"lights-solid": {"g": 1}, "reboot": {"value": True}}, None),
    "no script": (AUTONOMY_COMMAND, "ann", {}, None),
    "driving": (DRIVE, "ann", {"x": 1, "key": "sentinel"}, None),
    "a flag that cannot be read": (c.MQTT_VIDEO, "ann", {"value": "sentinel"}, None),
}
# fmt: on


@pytest.mark.parametrize("name", ROWS)
def test_what_is_noted_of_a_command(log: Log, name: str) -> None:
    channel, by, payload, row = ROWS[name]
    log.send(channel, by, **payload)
    assert log.rows() == ([] if row is None else [row])
    assert b"sentinel" not in log.path.read_bytes()


def test_a_stop_that_is_repeated_is_one_row_and_another_is_another(log: Log) -> None:
    for number in range(250):
        for _ in range(2):
            log.send(ESTOP, None, stop=f"{number:016x}", by="ann")
    log.send(ESTOP, None, by="ann")
    log.send(ESTOP, None, by="ann")
    log.send(ESTOP, "ann", stop="0" * 16)
    rows = log.rows()
    assert [row.get("stop") for row in rows[:250]] == [f"{number:016x}" for number in range(250)]
    assert [(row["who"], row.get("count", 1)) for row in rows[250:]] == [("ann?", 1), ("ann", 1), ("ann?", 1)]


def test_lights_that_go_on_are_one_row_until_they_rest_and_sounds_leave_room(log: Log) -> None:
    for now in (0.0, 30.0, 89.0, 150.0):
        log.now = now
        for colour in (1, 0, 1):
            log.send(c.LIGHTS_SOLID, "ann", r=colour)
    for number in range(200):
        log.send(c.SOUNDBOARD_COMMAND, "eve", action="play", file=f"{number}.wav")
    log.send(ESTOP, "ann", stop=STOP)
    rows = log.rows()
    assert [(row["what"], row.get("on")) for row in rows[:4]] == [("lights", True), ("lights", False)] * 2
    sounds = [row for row in rows if row["what"] == "sound-start"]
    assert len(sounds) == OF_STRANGERS - 2 + 2, "those beyond are counted"
    assert {"what": "stop", "who": "ann", **OUTSIDE, "stop": STOP, "why": ""} in rows


def test_control_is_given_and_ends(log: Log) -> None:
    otto = {"by": "otto", "id": ID, "key": "aa", "device": "pad"}
    ann = {"by": "ann", "id": "0000000b", "key": "bb", "named": False}
    log.control(**otto)  # from before the bridge has started
    log.control(**otto, asks="ann")
    log.control(**ann)
    log.control()
    log.control(boot="another")
    log.control(**{**otto, "by": ""}, boot="another")
    log.control(**otto, boot="a third")
    holder = {"who": "otto", "id": ID, "device": "pad"}
    other = {"who": "ann?", "id": "0000000b", "device": ""}
    given, ended = {"what": "control-given"}, {"what": "control-ended"}
    nobody = holder | {"who": "?"}
    passed = [ended | holder, given | other, ended | other, given | nobody, ended | nobody, given | holder]
    assert log.rows() == passed
    assert "aa" not in log.path.read_text()


RESET = ("", None)
#: Motor owners; what happens: a reset passes, or an owner publishes why it has refused one; the rows about refusals.
ANSWERS: dict[str, tuple[str, list[tuple[str, str | None]], list[str]]] = {
    "obeyed": ("a", [("a", None), RESET, ("a", None)], []),
    "refused": ("a", [("a", None), RESET, ("a", "count")], ["a count"]),
    "by an owner that has restarted": ("a", [("a", None), RESET, ("a", "boot")], ["a boot"]),
    "once more": ("a", [("a", None), RESET, ("a", "old"), RESET, ("a", "old")], ["a old", "a old"]),
    "and the state comes again": ("a", [("a", None), RESET, ("a", "count"), ("a", "count")], ["a count"]),
    "before it is noted": ("a", [("a", None), ("a", "count"), RESET], ["a count"]),
    "before the start": ("a", [("a", "old")], []),
    "for another owner": ("ab", [("a", None), ("b", None), RESET, ("a", "boot"), ("b", None)], []),
}


@pytest.mark.usefixtures("log")
@pytest.mark.parametrize("name", ANSWERS)
def test_a_reset_that_a_motor_owner_refuses_is_told(name: str) -> None:
    owners, events, refusals = ANSWERS[name]
    log = Log(*owners)
    for owner, why in events:
        if (owner, why) == RESET:
            log.send(ESTOP_RESET, "ann", boot="b", count=1)
        else:
            log.audit.estop(owner, estop_state(reset_refused=why))
    rows = [f"{row['owner']} {row['why']}" for row in log.rows() if row["what"] == "reset-refused"]
    assert rows == refusals


def test_refusals_of_one_kind_and_sender_are_one_row(log: Log) -> None:
    for _ in range(3):
        log.audit.refused(Drop.LATE, ESTOP, "eve")
        log.audit.refused(Drop.ECHO, ESTOP, "eve")
    log.audit.refused(Drop.TOO_MANY, None, None)
    late = {"what": "refused", "who": "eve", **OUTSIDE, "name": "estop", "why": Drop.LATE.value}
    many = {"what": "refused", "who": "?", **OUTSIDE, "name": "", "why": Drop.TOO_MANY.value}
    assert log.rows() == [late, many, late | {"count": 2}]


def test_the_log_is_the_robots_own_and_turns_over(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    assert until(log.path.exists)
    assert stat.S_IMODE(log.path.stat().st_mode) == 0o600
    assert stat.S_IMODE(log.path.parent.stat().st_mode) == 0o700
    monkeypatch.setattr(robot_audit, "_MOST_BYTES", 300)
    log.path.write_bytes(b"a" * 299 + b"\n")
    for number in range(2):
        log.audit.note("stop", number=number)
        assert until(lambda number=number: log.path.read_bytes().endswith(b'"number":%d}\n' % number))
    assert log.older.read_bytes().startswith(b"aaa")
    assert len(log.path.read_bytes().splitlines()) == 2


def test_a_disk_that_is_full_leaves_the_log_whole(
    log: Log, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    write = os.write
    assert until(log.path.exists)
    with monkeypatch.context() as patched:
        patched.setattr("os.write", lambda file, content: write(file, content[:10]))
        for number in range(3):
            log.audit.note("stop", number=number)
        assert until(lambda: DISK_IS_FULL in caplog.text)
    assert [row["number"] for row in log.rows()] == [0, 1, 2]
    assert caplog.text.count(DISK_IS_FULL) == 1


def test_half_a_line_is_left_to_itself(log: Log) -> None:
    assert until(log.path.exists)
    with log.path.open("ab") as file:
        file.write(b'{"t":4')
    log.audit.note("stop")
    log.audit.close()
    lines = log.path.read_bytes().splitlines()
    assert lines[1] == b'{"t":4'
    assert json.loads(lines[2])["what"] == "stop"
