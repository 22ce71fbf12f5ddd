"""The robot's audit: what becomes a row, whose quota it takes, what a disk does to it, and how it is read."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

from pebble.contract import AUTONOMY_COMMAND, CONTROL_STATE, CONTROL_TAKE, DRIVE, ESTOP, ESTOP_RESET, ESTOP_STATE, chain
from pebble.contract import channels as c
from pebble.forwarding.routing import Drop
from pebble.services.mqtt_bridge.acts import Acts
from pebble.services.mqtt_bridge.audit import LINES_BYTES, THIN_LINES_BYTES, chain_files
from pebble.services.mqtt_bridge.audit_rows import ACCOUNTS, OTHERS, ROBOT, WAITING, AuditRows
from pebble.services.mqtt_bridge.chain_files import ChainFiles
from tests.services.mqtt_bridge.bridge_rig import BASE, MemoryRig, make_config
from tests.support import cases, until

OWNER = "serial"
STOP = "0123456789abcdef"


class Watched:
    """Acts with a clock of their own, and what became of them."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.acts = Acts(BASE, [OWNER], lambda: self.now, lambda: self.now)

    def control(self, **state: Any) -> None:
        whole = {"by": "", "id": "", "key": "", "boot": "b", "named": True, **state}
        self.acts.state(CONTROL_STATE.topic(BASE, owner=OWNER), json.dumps(whole).encode())

    def estop(self, **state: Any) -> None:
        whole = {"latched": False, "boot": "b", "count": 0, "recent": [], "by": "", "why": "", "since": 0, **state}
        self.acts.state(ESTOP_STATE.topic(BASE, owner=OWNER), json.dumps(whole).encode())

    def send(self, channel: c.Channel, sender: str | None, **payload: Any) -> None:
        self.acts.passed(channel, sender, json.dumps(payload).encode())

    def rows(self) -> list[dict[str, Any]]:
        """The acts since the last call, without their times."""
        self.now += 1.0
        self.acts.follow_states()
        self.now += 1.0
        return [{key: value for key, value in row.items() if key != "t"} for row in self.acts.acts.take(self.now)]

    def refused(self) -> list[tuple[str, str]]:
        self.now += 1.0
        return [(row["what"], row["who"]) for row in self.acts.refused.take(self.now)]


@pytest.fixture
def watched() -> Watched:
    one = Watched()
    one.control()
    one.estop()
    assert one.rows() == []  # what was before it started
    return one


def test_control_is_given_asked_for_taken_released_and_ends(watched: Watched) -> None:
    otto = {"by": "otto", "id": "00000001", "key": "aa", "device": "pad"}
    ann = {"by": "page-1/ann", "id": "00000002", "key": "bb"}
    watched.control(**otto)
    assert watched.rows() == [{"what": "control-given", "who": "otto", "device": "pad"}]
    for _ in range(20):
        watched.send(DRIVE, "otto", x=0.5, key="aa")
    watched.control(**otto, asks="page-1/ann", asks_id="00000002")
    assert watched.rows() == [{"what": "control-asked", "who": "page-1/ann"}]
    watched.send(CONTROL_TAKE, "page-1", id="00000002", by="ann")
    watched.control(**ann)
    assert watched.rows() == [
        {"what": "control-ended", "who": "otto", "device": "pad", "seconds": 4.0, "commands": 20, "why": "another"},
        {"what": "control-taken", "who": "page-1/ann"},
    ]
    watched.control()  # its state may be received before the request is noted
    watched.send(c.CONTROL, "page-1", id="00000002", want="release")
    assert watched.rows() == [{"what": "control-released", "who": "page-1/ann", "seconds": 2.0, "commands": 0}]
    watched.control(**otto)
    watched.control(by="", boot="another")
    assert [row["what"] for row in watched.rows()] == ["control-given", "control-ended"]


def test_a_request_with_the_id_of_another_account_explains_nothing(watched: Watched) -> None:
    watched.control(by="mia", id="00000001", key="aa")
    watched.rows()
    watched.send(c.CONTROL, "otto", id="00000001", by="mia", want="release")
    watched.send(CONTROL_TAKE, "boss", id="00000002", by="otto")
    watched.control(by="otto", id="00000002", key="bb")
    assert [row["what"] for row in watched.rows()] == ["control-ended", "control-given"]


@pytest.mark.parametrize(
    ("channel", "by", "payload", "row"),
    [
        (ESTOP, "ann", {"stop": STOP, "why": "cat"}, {"what": "stop", "who": "ann", "why": "cat"}),
        (ESTOP, "-", {"by": "Ann"}, {"what": "stop", "who": "ann?"}),
        (ESTOP, None, {}, {"what": "stop", "who": "?"}),
        (AUTONOMY_COMMAND, "ann", {"file": "f", "enabled": True}, {"what": "script-start", "who": "ann", "file": "f"}),
        (AUTONOMY_COMMAND, ROBOT, {"action": "stop"}, {"what": "script-stop", "who": ROBOT}),
        (c.REBOOT, "robot", {"value": True}, {"what": "action", "who": "robot", "name": "reboot"}),
        (c.MQTT_VIDEO, "ann", {"value": False}, {"what": "flag", "who": "ann", "name": "mqtt-video", "on": False}),
    ],
)  # fmt: skip
def test_a_command_is_an_act(watched: Watched, channel: Any, by: Any, payload: Any, row: dict[str, Any]) -> None:
    watched.send(channel, by, **payload)
    assert watched.rows() == [row]


def test_what_moves_nothing_and_what_only_drives_is_none(watched: Watched) -> None:
    watched.send(DRIVE, "ann", x=1)
    watched.send(c.REBOOT, "ann", value=False)
    watched.send(AUTONOMY_COMMAND, "ann")
    watched.send(c.LIGHTS_SOLID, "ann", r=1)
    watched.send(c.CONTROL, "ann", id="00000001")
    assert watched.rows() == []


def test_a_stop_is_one_row_with_the_name_that_was_checked(watched: Watched) -> None:
    watched.send(ESTOP, "-", stop=STOP, by="somebody")
    watched.send(ESTOP, "ann", stop=STOP)
    for _ in range(3):  # repeated until it is confirmed
        watched.send(ESTOP, "-", stop=STOP)
    watched.estop(latched=True, count=1, recent=[STOP], by="-")
    assert watched.rows() == [{"what": "stop", "who": "ann"}]
    watched.send(ESTOP_RESET, "eve", boot="b", count=7)  # of another stop
    watched.send(ESTOP_RESET, "ben", boot="b", count=1)
    watched.estop(latched=False, count=1, recent=[STOP])
    assert watched.rows() == [{"what": "reset", "who": "ben"}]
    watched.estop(latched=True, count=2, recent=["f" * 16, STOP], by="button")  # from within the robot
    watched.send(ESTOP_RESET, "ben", boot="b", count=2)  # before the state was looked at
    watched.estop(latched=False, count=2, recent=["f" * 16, STOP])
    assert watched.rows() == [{"what": "stop", "who": "button?"}, {"what": "reset", "who": "ben"}]


def test_a_command_with_an_old_key_is_refused(watched: Watched) -> None:
    watched.control(by="otto", id="00000001", key="aa")
    for key, x in (("aa", 1), ("bb", 0), ("bb aa", 1)):
        watched.send(DRIVE, "otto", x=x, key=key)
    assert watched.refused() == []
    watched.send(DRIVE, "eve", x=1, key="bb")
    assert watched.refused() == [("wrong key", "eve")]


def test_refusals_are_one_row_a_minute_for_each_account_and_reason(watched: Watched) -> None:
    drops = (Drop.UNNAMED, Drop.LATE, Drop.STALE, Drop.SIGNED, Drop.ECHO)
    refusals = cases(5_000, 100_000)
    for number in range(refusals):
        watched.acts.drop(drops[number % 5], f"eve{number % 1000}")
    first = watched.refused()
    assert len(first) <= 4 * ACCOUNTS
    assert ("late", OTHERS) in first
    watched.now += 60.0
    rows = watched.acts.refused.take(watched.now)
    assert sum(row["count"] for row in rows) + len(first) == 4 * refusals // 5
    assert len(rows) <= 4 * (ACCOUNTS + 1)


def test_who_floods_takes_no_row_from_others() -> None:
    rows, now = AuditRows(200, 300.0), 0.0
    for number in range(10_000):
        rows.add({"t": now, "what": "script-start", "who": "eve", "file": str(number)}, "eve", now)
    rows.add({"t": now, "what": "script-start", "who": "ann"}, "ann", now)
    written = rows.take(1.0)
    assert len(written) == 201
    assert written[-1]["who"] == "ann"
    [merged] = rows.take(301.0)
    assert (merged["count"], merged["since"], merged["file"]) == (9_800, 0.0, "9999")
    a_day = 86_400
    later = sum(len(flooded(rows, 1000.0 + second)) for second in range(0, a_day, 60))
    assert later <= 200 + a_day / 300


def flooded(rows: AuditRows, now: float) -> list[dict[str, Any]]:
    for _ in range(10):
        rows.add({"t": now, "what": "script-start", "who": "eve"}, "eve", now)
    return rows.take(now)


def test_what_cannot_be_written_waits_within_bounds() -> None:
    rows = AuditRows(10 * WAITING, 1.0)
    for now in range(3):  # also what comes while it is tried
        taken = rows.take(float(now))
        for number in range(WAITING):
            rows.add({"t": 0.0, "what": "stop", "who": "ann", "number": number}, "ann", float(now))
            rows.add({"t": 0.0, "what": "stop", "who": "ben", "number": number}, "ben", float(now))
        rows.give_back(taken, float(now))
    taken = rows.take(3.0)
    assert len(taken) == WAITING
    rows.written()
    assert sum(row.get("count", 1) for row in [*taken, *rows.take(4.0)]) == 6 * WAITING


def row(number: int) -> dict[str, Any]:
    return {"t": float(number), "what": "stop", "who": "ann", "number": number}


def test_a_chain_goes_on_in_the_next_file_and_process(tmp_path: Path) -> None:
    path = tmp_path / "new" / "acts.jsonl"
    for number in range(50):
        files = ChainFiles(path, 1000)
        files.append([row(number)])
        last = chain.parse(files.newest(0, 1)[0])
        assert last is not None
        assert (last.mark, last.n) == (files.mark, number + 1)
    assert files.older.stat().st_size < 1300
    whole = list(files.lines())
    assert len(whole) < 25  # older ones are gone
    assert chain.verify(whole, [files.mark]) == ""
    assert files.newest(0, 1000) == whole
    assert [json.loads(raw)["n"] for raw in files.newest(48, 3)] == [45, 46, 47]


@pytest.mark.parametrize("end", [b'{"n":4,"t":3.0,"wh', b"\0" * 5000, b'{"n":4}\n', b"\xff\n" * 70_000])
def test_a_torn_end_is_dropped_with_a_note(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, end: bytes) -> None:
    path = tmp_path / "acts.jsonl"
    ChainFiles(path, 10**6).append([row(1), row(2), row(3)])
    with path.open("ab") as file:
        file.write(end)
    files = ChainFiles(path, 10**6)
    with monkeypatch.context() as patched:  # the first note is lost
        patched.setattr("os.write", lambda _file, _content: 0)
        with pytest.raises(OSError, match="space"):
            files.append([row(4)])
    files.append([row(4)])
    files.append([row(5)])
    written = [json.loads(raw) for raw in files.lines()]
    assert [one["what"] for one in written] == ["stop"] * 3 + ["torn", "stop", "stop"]
    assert written[3]["bytes"] == len(end)
    assert chain.verify(files.lines(), [files.mark]) == ""


def test_a_disk_that_takes_nothing_leaves_the_chain_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = ChainFiles(tmp_path / "acts.jsonl", 10**6)
    files.append([row(1)])
    mark = files.mark

    write = os.write

    with monkeypatch.context() as patched:
        patched.setattr("os.write", lambda file, content: write(file, content[:10]))
        with pytest.raises(OSError, match="space"):
            files.append([row(2)])
    assert files.mark == mark
    files.append([row(3)])
    assert chain.verify(files.lines(), [files.mark]) == ""


def test_a_disk_that_takes_no_new_file_costs_no_file_of_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = ChainFiles(tmp_path / "acts.jsonl", 100)
    files.append([row(1)])
    files.append([row(2)])
    real, closed = os.open, list[int]()

    def full(path: Any, flags: int, mode: int = 0o777) -> int:
        if flags & os.O_EXCL:
            raise OSError(28, "No space left on device")
        return real(path, flags, mode)

    with monkeypatch.context() as patched:
        patched.setattr("os.open", full)
        patched.setattr("os.close", closed.append)
        with pytest.raises(OSError, match="space"):
            files.append([row(3)])
    assert len(closed) == 1
    os.close(closed[0])
    files.append([row(4)])
    assert chain.verify(files.lines(), [files.mark]) == ""


def test_a_bridge_writes_and_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = MemoryRig(monkeypatch)
    try:
        bridge = rig.bridge()
        rig.remote.publish("incoming/estop", json.dumps({"stop": STOP, "by": "ann"}).encode())
        rig.remote.publish("incoming/autonomy-command", b'{"action": "stop"}', retain=True)  # live, though retained
        rig.local.publish("incoming/autonomy-command", b'{"action": "start", "file": "a"}')
        written = chain_files(make_config())["acts"]

        def rows() -> list[dict[str, Any]]:
            return [json.loads(raw) for raw in written.lines()]

        wanted = {("stop", "ann?"), ("script-start", ROBOT)}
        assert until(lambda: wanted <= {(one["what"], one["who"]) for one in rows()}), rows()
        assert rows()[0]["what"] == "start"
        assert rows()[0]["level"] == "open"
        assert until(lambda: rig.remote.payloads("outgoing/audit"))
        assert rig.remote.on("outgoing/audit")[0].payload.startswith(b'{"acts":{"n":')
        rig.remote.publish("incoming/audit-read", b'{"chain": "acts", "before": 3, "count": 50}')
        assert until(lambda: rig.remote.payloads("outgoing/audit-lines"))
        [answer] = rig.remote.payloads("outgoing/audit-lines")
        assert len(answer) <= LINES_BYTES + 100
        assert json.loads(answer)["before"] == 3
        assert [one.encode() for one in json.loads(answer)["lines"]] == list(written.lines())[:2]
        assert bridge.status.counts
    finally:
        rig.close()


@pytest.mark.parametrize(("profile", "most"), [("wide", LINES_BYTES), ("thin", THIN_LINES_BYTES)])
def test_an_answer_is_as_long_as_its_link_permits(monkeypatch: pytest.MonkeyPatch, profile: str, most: int) -> None:
    rig = MemoryRig(monkeypatch)  # with a state folder of its own
    try:
        chain_files(make_config())["acts"].append([row(number) for number in range(200)])
        rig.bridge(link={"profile": profile})
        rig.remote.publish("incoming/audit-read", b'{"chain": "acts", "before": 0, "count": 200}')
        assert until(lambda: rig.remote.payloads("outgoing/audit-lines"))
        [answer] = rig.remote.payloads("outgoing/audit-lines")
        assert most / 2 < len(answer) <= most + 100
    finally:
        rig.close()


def test_a_robot_whose_disk_is_full_drives_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_self: ChainFiles, _rows: list[Any]) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(ChainFiles, "append", full)
    rig = MemoryRig(monkeypatch)
    try:
        rig.bridge()
        assert until(lambda: rig.remote.payloads("outgoing/audit"))
        assert json.loads(rig.remote.payloads("outgoing/audit")[0])["saved"] is False
        rig.remote.publish("incoming/drive-values", b'{"x": 1}')
        assert until(lambda: rig.local.payloads("incoming/drive-values"))
    finally:
        rig.close()
