"""The manager as a process, with real scripts, on both transports."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.ext.scripts.autonomy_manager.manager_rig import SLEEPER, ManagerRig, alive, started
from tests.support import Broker, gone, until

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
    assert rig.newest("autonomy-files")["files"] == [
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
    killed = time.monotonic()
    assert until(lambda: all(map(gone, pids)), 5)
    assert time.monotonic() - killed < 1.0 + 1.5  # a busy machine's share


def test_a_stopped_manager_leaves_none_either_and_publishes_so(mqtt: ManagerRig) -> None:
    pids = family(mqtt, PARENT)
    mqtt.end()
    assert until(lambda: all(map(gone, pids)), 1), "killed when it ended"
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
    assert mqtt.newest("capabilities")["value"]["autonomy"]["available"] is True
    mqtt.end(signal.SIGKILL)
    assert until(lambda: all(map(gone, pids)), 5)


def test_scripts_inherit_nothing_of_the_launchers(mqtt: ManagerRig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PEBBLE_WANTED", "camera_publisher=")
    monkeypatch.setenv("PEBBLE_RUN", "5")
    found = "[dict(os.environ), os.getpgid(0) == os.getpid(), sys.stdin.read()]"
    text = f"import json, os, sys\njson.dump({found}, open('env', 'w'))"
    folder = mqtt.script("look", text, env={"TEA": "hot"})
    monkeypatch.setenv("CUP", "1")
    mqtt.start()
    mqtt.launch("look")
    assert until(lambda: mqtt.status.get("running") is False and (folder / "env").exists() and not alive(str(folder)))
    variables, leads_group, stdin = json.loads((folder / "env").read_text())
    assert not variables.keys() & {"PEBBLE_WANTED", "PEBBLE_RUN", "PEBBLE_NOTIFY_FD"}
    assert (variables["TEA"], variables["CUP"], variables["PEBBLE_CONFIG"]) == ("hot", "1", str(mqtt.path))
    assert (leads_group, stdin) == (True, "")
