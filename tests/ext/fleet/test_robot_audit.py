"""The robot's audit: what becomes a row, what a disk does to it, and how it is read."""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pebble.contract import AUTONOMY_COMMAND, CONTROL_TAKE, DRIVE, ESTOP, ESTOP_RESET, codec
from pebble.contract import channels as c
from pebble.extensions.fleet import robot_audit as audit_module
from pebble.extensions.fleet.robot_audit import ROBOT, Audit, files
from pebble.extensions.fleet.row_writer import OF_STRANGERS
from pebble.forwarding.routing import Drop
from tests.commands.command_line import Run
from tests.services.mqtt_bridge.bridge_rig import MemoryRig, make_config
from tests.support import until

STOP = "0123456789abcdef"
ID = "0000000a"
SCRIPT = {"file": "f" * 80, "enabled": True, "config": {"password": "sentinel"}, "by": "ann"}
DISK_IS_FULL = "No space left on device"


class Log:
    """An audit with a folder of its own, and its rows but for their times."""

    def __init__(self) -> None:
        config = make_config()
        self.path, self.older = files(config)
        self.now = 0.0
        self.audit = Audit(config, lambda: self.now)
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
    monkeypatch.setattr(audit_module, "_MOST_BYTES", 300)
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


def test_a_bridge_notes_what_passes_and_a_command_prints_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    rig = MemoryRig(monkeypatch)
    try:
        rig.bridge()
        path, older = files(make_config())
        rig.remote.publish("incoming/estop", json.dumps({"stop": STOP, "by": "ann"}).encode())
        rig.remote.publish("incoming/autonomy-command", b'{"action": "stop"}', retain=True)  # live, though retained
        rig.local.publish("incoming/autonomy-command", b'{"action": "start", "file": "a"}')
        assert until(lambda: path.exists() and path.read_bytes().count(b"\n") == 4), path.read_text()
    finally:
        rig.close()
    with path.open("ab") as file:
        file.write(b'{"t": "x"}\n\n[1]\n{"t":1e99}\n{"t":1,"what":"stop","count":9,"by":"\\u001b[2J"}\n')
    older.write_bytes(b'{"t":0,"what":"first"}\n')
    robot = tmp_path / "rover.json"
    robot.write_text(json.dumps({"robot": {"id": "rover"}, "services": {}}))
    pebble = Run(monkeypatch, capsys)
    assert pebble("fleet", "audit", robot, columns=200) == 0
    lines = [line.rstrip() for line in pebble.out.splitlines()]
    assert [line.split()[2] for line in lines[1:3]] == ["first", "start"]
    shown = [line.split()[2:] for line in lines[3:6]]  # of two connections
    assert ["stop", "ann?", "operators", "stop", STOP] in shown
    assert ["script-start", ROBOT, "robot", "file", "a"] in shown
    assert {row[0] for row in shown} == {"stop", "script-start", "refused"}
    assert "× 9" in lines[6]
    assert lines[6].endswith(r"by \u001b[2J")
    assert lines[8].startswith("3 lines cannot be read")
    assert pebble("fleet", "audit", robot, "-n", "1") == 0
    assert ("× 9" in pebble.out, pebble.out.count("\n")) == (True, 3)
