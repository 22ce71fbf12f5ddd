"""The manager as a process, with real scripts in a folder, on both transports, seen from outside."""

from __future__ import annotations

import errno
import json
import os
import signal
import stat
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from pebble.errors import PebbleError
from pebble.services.autonomy_manager import guard
from pebble.services.autonomy_manager.child import Launch, Process, Processes
from pebble.services.autonomy_manager.guard import Guard
from pebble.transports import Message
from tests.kit.robot import ROBOT, Program, ProgramRobot
from tests.support import ROOT, WAIT_S, Broker, Child, gone, quickly, refused, until

#: Sleeps, and ends as asked; leaves its command line beside itself. It speaks no MQTT and drives nothing.
SLEEPER = """
import json, os, sys, time
with open("started.jsonl", "a") as file:
    file.write(json.dumps([os.getpid(), sys.argv[1:], os.environ.get("PEBBLE_RUN")]) + "\\n")
time.sleep(600)
"""


class ManagerRig(ProgramRobot):
    """``scripts`` of the config are those written with :meth:`script`; drive commands are collected as well."""

    process: Program | Child | None = None

    def __init__(self, kind: str, port: int, **section: Any) -> None:
        super().__init__(kind, port, {}, robot=ROBOT)
        self.root, self.log = self.folder / "scripts", self.folder / "log"
        self.root.mkdir()
        self.drives: list[dict[str, Any]] = []
        self.world.transport.subscribe(f"{self.world.base}/incoming/drive-values", self._on_drive, direct=True)
        times = {"stop_timeout_seconds": 2}
        self.section: dict[str, Any] = {"enabled": True, "autonomy_root": str(self.root), **times, **section}
        self.section["scripts"] = {}
        self.raw["services"] = {"autonomy_manager": self.section}
        self._ends.callback(self.end)

    def script(self, name: str, text: str = SLEEPER, file: str = "run.py", **section: Any) -> Path:
        """Write a script."""
        folder = self.root / name
        folder.mkdir()
        (folder / file).write_text(text)
        (folder / file).chmod(stat.S_IRWXU)
        self.section["scripts"][name] = section
        return folder

    def start(self, *command: str) -> None:
        """Start the manager alone, or with ``command`` what runs it."""
        before = len(self.world.on("autonomy-files"))
        self.config = self.write()
        if command:
            with self.log.open("a") as log:
                self.process = Child([sys.executable, "-m", *command, str(self.path)], cwd=ROOT, stderr=log)
        else:
            self.process = Program("pebble.services.autonomy_manager.service:AutonomyManager", str(self.path))
        assert until(lambda: len(self.world.on("autonomy-files")) > before and self.listed()), self.logged()

    def end(self, number: signal.Signals = signal.SIGTERM) -> None:
        process, self.process = self.process, None
        if process is not None:
            process.send_signal(number)
            process.wait(WAIT_S)

    def listed(self) -> bool:
        """True if every script is in the published list, and was asked what it needs."""
        newest = self.world.newest("autonomy-files")
        asked = {entry["file"] for entry in newest.get("files", ()) if entry.get("asked", True)}
        return bool(newest) and asked >= set(self.section["scripts"])

    @property
    def status(self) -> dict[str, Any]:
        status: dict[str, Any] = self.world.newest("autonomy-status")
        return status

    def becomes(self, timeout: float = WAIT_S, **fields: Any) -> bool:
        """Wait until the status has these fields."""
        return self.world.became("autonomy-status", timeout, **fields)

    def command(self, body: Any, *, retain: bool = False) -> None:
        self.world.command("autonomy-command", body, retain=retain)

    def launch(self, name: str, **config: Any) -> None:
        """Send the command that starts a script."""
        self.command({"action": "start", "file": name, "config": config})

    def run_script(self, name: str, **config: Any) -> int:
        """Start a script, and return its pid once it is published as running."""
        self.launch(name, **config)
        assert self.becomes(running=True, file=name), (self.status, self.logged())
        return int(self.status["pid"])

    def logged(self) -> str:
        return self.process.printed if isinstance(self.process, Program) else self.log.read_text()

    def _on_drive(self, message: Message) -> None:
        self.drives.append(msgspec.json.decode(message.payload))


def started(folder: Path) -> list[tuple[int, list[str], str | None]]:
    """What each start of a sleeper left in its folder: pid, arguments, and its run."""
    try:
        lines = (folder / "started.jsonl").read_text().splitlines()
    except FileNotFoundError:
        return []
    return [tuple(json.loads(line)) for line in lines]


#: Starts a process of its own, and leaves both numbers.
PARENT = """
import os, subprocess, sys, time
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)", "grandchild"])
open("pids.new", "w").write(f"{os.getpid()} {child.pid}")
os.rename("pids.new", "pids")
time.sleep(600)
"""
DEAF = "import signal\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
#: One of ours by its syntax, so that it is asked for its settings; it needs no robot.
OURS = """
import sys
if sys.argv[1:] == ["--describe"]:
    print('{"label": "Ours", "configs": [{"key": "n", "type": "int", "default": 1, "arg": "--n"}]}')
    raise SystemExit
if not sys.argv:
    from pebble import run
"""


@pytest.fixture(params=["mqtt", "zenoh"])
def rig(request: pytest.FixtureRequest, local: Broker) -> Iterator[ManagerRig]:
    with ManagerRig(request.param, local.port) as rig:
        yield rig


@pytest.fixture
def mqtt(local: Broker) -> Iterator[ManagerRig]:
    with ManagerRig("mqtt", local.port) as rig:
        yield rig


def pids_in(folder: Path) -> list[int]:
    """The numbers of a PARENT and its child."""
    assert until((folder / "pids").exists)
    return [int(word) for word in (folder / "pids").read_text().split()]


def family(rig: ManagerRig, text: str, *command: str) -> list[int]:
    """Start the manager, or what runs it, and a script that starts a process; return the numbers of both."""
    folder = rig.script("family", text)
    rig.start(*command)
    rig.run_script("family")
    return pids_in(folder)


def test_a_script_is_listed_started_and_stopped(rig: ManagerRig) -> None:
    folder = rig.script("walk", args=[{"key": "speed", "type": "float", "default": 0.5, "arg": "--speed", "max": 1}])
    rig.script("ours", OURS + SLEEPER)
    rig.start()
    assert rig.world.newest("autonomy-files")["files"] == [
        {"file": "ours", "label": "Ours",
         "configs": [{"key": "n", "label": "n", "type": "int", "default": 1, "arg": "--n"}]},
        {"file": "walk", "label": "walk",
         "configs": [{"key": "speed", "label": "speed", "type": "float", "default": 0.5, "arg": "--speed", "max": 1}]},
    ]  # fmt: skip
    pid = rig.run_script("walk", speed="0.25")
    assert until(lambda: started(folder))
    assert started(folder) == [(pid, ["--config", str(rig.path), "--speed", "0.25"], None)]
    assert rig.status["config"] == {"speed": 0.25}
    rig.command({"value": {"enabled": False}})
    assert rig.becomes(running=False)
    assert gone(pid)
    assert rig.status["error"] is None
    rig.run_script("ours")
    assert until(lambda: started(rig.root / "ours"))
    ((_, arguments, run),) = started(rig.root / "ours")
    assert (arguments[2:], rig.drives[0]["run"] < int(run or 0)) == (["--n", "1"], True)


@pytest.mark.parametrize("text", [PARENT, OURS + DEAF + PARENT], ids=["foreign", "ours"])
def test_a_killed_manager_leaves_no_script_and_nothing_it_started(mqtt: ManagerRig, text: str) -> None:
    pids = family(mqtt, text)
    mqtt.end(signal.SIGKILL)
    with quickly():
        assert until(lambda: all(map(gone, pids)))


def test_a_stopped_manager_leaves_none_either_and_publishes_so(mqtt: ManagerRig) -> None:
    pids = family(mqtt, PARENT)
    mqtt.end()
    assert until(lambda: all(map(gone, pids))), "killed when it ended"
    assert until(lambda: (mqtt.status["running"], mqtt.status["pid"]) == (False, None))


def test_a_script_that_will_not_end_is_killed_with_all_it_started(mqtt: ManagerRig) -> None:
    mqtt.section["stop_timeout_seconds"] = 0.3
    pids = family(mqtt, DEAF + PARENT)
    mqtt.command({"action": "stop"})
    assert mqtt.becomes(running=False)
    assert until(lambda: all(map(gone, pids)))
    assert mqtt.status["error"] is None


def test_what_a_script_leaves_behind_ends_with_it(mqtt: ManagerRig) -> None:
    folder = mqtt.script("family", PARENT.replace("time.sleep(600)\n", "raise SystemExit(3)\n", 2)[:-1])
    mqtt.start()
    mqtt.launch("family")
    assert mqtt.becomes(error="family exited with code 3")
    assert until(lambda: all(map(gone, pids_in(folder))))


def test_a_retained_start_runs_nothing_when_the_manager_starts(rig: ManagerRig) -> None:
    rig.script("walk")
    rig.script("live")
    rig.command({"action": "start", "file": "walk"}, retain=True)
    before = len(rig.world.payloads("autonomy-status"))  # of the robot of another test
    for _ in range(2):
        rig.start()
        rig.run_script("live")  # after the retained command has been refused
        rig.end()
    statuses = rig.world.payloads("autonomy-status")[before:]
    assert {(status["file"], status["error"]) for status in statuses} == {(None, None), ("live", None)}


def test_a_launcher_logs_a_scripts_lines_under_its_name_and_when_killed_leaves_no_script(mqtt: ManagerRig) -> None:
    pids = family(mqtt, "print('08:00:00 [ERROR] no camera', flush=True)" + PARENT, "pebble", "up")
    expected = ("autonomy_manager:family", "ERROR", pids[0], "[autonomy_manager:family] no camera")
    assert until(lambda: expected in [
        tuple(record[key] for key in ("service", "level", "pid", "message")) for record in mqtt.world.payloads("logs")
    ])  # fmt: skip
    assert mqtt.world.newest("capabilities")["value"]["autonomy"]["available"] is True
    mqtt.end(signal.SIGKILL)
    assert until(lambda: all(map(gone, pids)))


def test_scripts_inherit_nothing_of_the_launchers(mqtt: ManagerRig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PEBBLE_WANTED", "camera_publisher=")
    monkeypatch.setenv("PEBBLE_RUN", "5")
    found = "[dict(os.environ), os.getpgid(0) == os.getpid(), sys.stdin.read()]"
    text = f"import json, os, sys\njson.dump({found}, open('new', 'w'))\nos.rename('new', 'env')"
    folder = mqtt.script("look", text, env={"TEA": "hot"})
    monkeypatch.setenv("CUP", "1")
    mqtt.start()
    mqtt.launch("look")
    assert until(lambda: mqtt.status.get("running") is False and (folder / "env").exists())
    variables, leads_group, stdin = json.loads((folder / "env").read_text())
    assert not variables.keys() & {"PEBBLE_WANTED", "PEBBLE_RUN", "PEBBLE_NOTIFY_FD"}
    assert (variables["TEA"], variables["CUP"], variables["PEBBLE_CONFIG"]) == ("hot", "1", str(mqtt.path))
    assert (leads_group, stdin) == (True, "")


# -- a script whose file exists and cannot be executed is refused with the fix


def begun(path: Path) -> Process:
    return Process(Launch("turn", (str(path),), path.parent, dict(os.environ), signal.SIGKILL))


def program(folder: Path, text: str, mode: int) -> Path:
    path = folder / "turn.sh"
    path.write_text(text)
    path.chmod(mode)
    return path


@pytest.mark.parametrize(
    ("first", "mode", "problem"),
    [
        ("#!/bin/sh\n", 0o644, "^{path} is not executable: chmod \\+x {path}$"),
        ("#!/no/such/sh -e\n", 0o755, "there is no '/no/such/sh', which its first line names"),
        ("#!/bin/sh\r\n", 0o755, r"there is no '/bin/sh\\r', which its first line names"),
    ],
)
def test_what_cannot_be_executed_is_named_with_the_reason(first: str, mode: int, problem: str, tmp_path: Path) -> None:
    path = program(tmp_path, first, mode)
    with pytest.raises(PebbleError, match=problem.format(path=path)):
        begun(path)


@pytest.mark.parametrize(("first", "may"), [("#!/usr/bin/env -S sh -e\n", True), ("\n", True), ("#!/bin/sh\n", False)])
def test_others_start_and_their_end_is_noticed_also_where_pidfd_open_is_denied(
    first: str, may: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not may:
        monkeypatch.setattr(os, "pidfd_open", refused(errno.EPERM))
    codes: list[int] = []
    process = begun(program(tmp_path, f"{first}exit 7\n", 0o755))
    process.watch(codes.append)
    process.wait(WAIT_S)
    assert codes == [7]


# -- what is left of a manager that was killed ends before the next one starts anything


#: Starts a script that ignores SIGTERM, leaves its number in a file, and waits to be killed.
MANAGER = """
import os, signal, sys, time
from pathlib import Path
from pebble.services.autonomy_manager.child import Launch, Processes
deaf = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); open('deaf', 'w'); time.sleep(600)"
folder = Path(sys.argv[1])
script = Processes(folder / "lock")(
    Launch("deaf", (sys.executable, "-c", deaf), folder, dict(os.environ), signal.SIGTERM), print
)
(folder / "pid.new").write_text(str(script.pid))
(folder / "pid.new").rename(folder / "pid")
time.sleep(600)
"""


def test_no_script_starts_before_those_of_a_killed_manager_have_ended(tmp_path: Path) -> None:
    killed = Child([sys.executable, "-c", MANAGER, str(tmp_path)], cwd=ROOT)
    assert until(lambda: (tmp_path / "pid").exists() and (tmp_path / "deaf").exists())
    earlier = int((tmp_path / "pid").read_text())
    killed.kill()
    killed.wait(WAIT_S)
    assert not gone(earlier), "it has time to end by itself"

    processes, ended = Processes(tmp_path / "lock"), threading.Event()
    sleeper = Launch("sleeper", ("sleep", "600"), tmp_path, {}, signal.SIGKILL)
    script = processes(sleeper, lambda code: ended.set())
    assert gone(earlier), "it has ended before this one began"
    script.signal(signal.SIGKILL)
    assert ended.wait(WAIT_S)
    processes.close()


def test_a_lock_that_stays_taken_is_an_error_that_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "_LOCKED_S", 0.1)
    first, second = Guard(tmp_path / "lock"), Guard(tmp_path / "lock")
    first.begin()
    first.begin()
    with pytest.raises(PebbleError, match="lock"):
        second.begin()
    first.close()
    second.begin()
    second.close()


def test_without_locks_scripts_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("fcntl.flock", refused(errno.ENOLCK))
    unlocked = Guard(tmp_path / "lock")
    unlocked.begin()
    unlocked.close()
    assert "lock cannot be locked: No locks available" in caplog.text
