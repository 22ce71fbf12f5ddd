"""The launcher as a real process, with real children that misbehave in every way a child can."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from pebble.config import Config, load, parse
from pebble.errors import ConfigError
from pebble.launched import NOTIFY_FD
from pebble.launcher.launcher import Launcher
from pebble.launcher.program import Stage
from pebble.launcher.programs import programs, transport_modules
from pebble.launcher.run_lock import RunLock
from tests.support import ROOT, until

BASE = "pebble/robots/rover"
FAKES = ROOT / "tests" / "fakes"
FABRIC, NEWS, DEVICE, LINK = (int(stage) for stage in Stage)

Row = tuple[str, str, int]  # name, behaviour, stage


class Robot:
    """A launcher under test, seen from outside: its children's journal, what it published, what it wrote."""

    def __init__(self, folder: Path, rows: list[Row], *options: str, env: dict[str, str], **launcher: Any) -> None:
        self.journal, self.record, self.errors = folder / "journal", folder / "record", folder / "errors"
        self.run_dir = folder / "run"
        self.config = folder / "rover.json"
        self.config.write_text(json.dumps(_config(self.run_dir, launcher)))
        table = [(name, "fake_service", (name, behaviour, str(self.journal)), stage) for name, behaviour, stage in rows]
        self._command = [
            *(sys.executable, str(FAKES / "run_launcher.py"), str(ROOT), str(self.config)),
            *(json.dumps(table), str(self.record), *options),
        ]
        self._folder = folder / "somewhere else"
        self._folder.mkdir()
        (self._folder / "json.py").write_text("raise SystemExit('the working directory was imported from')\n")
        self._environment = {**os.environ, "PYTHONPATH": str(FAKES), **env}
        self.process = self._start(self.errors)

    def second(self) -> subprocess.CompletedProcess[str]:
        """Another launcher for the same robot."""
        return subprocess.run(
            self._command, cwd=self._folder, env=self._environment, capture_output=True, text=True, timeout=20
        )

    def _start(self, errors: Path) -> subprocess.Popen[bytes]:
        with errors.open("wb") as out:
            return subprocess.Popen(self._command, cwd=self._folder, env=self._environment, stderr=out)

    def stop(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(20)

    def events(self, name: str, event: str) -> list[int]:
        """The pids with which ``name`` noted ``event``."""
        lines = [line.split() for line in _lines(self.journal)]
        return [int(pid) for who, what, pid in lines if (who, what) == (name, event)]

    def end_leftovers(self) -> list[int]:
        """Every process the journal knows that is still there; none should be."""
        pids = [int(pid) for pid in re.findall(r"(?:start |child:)(\d+)", "\n".join(_lines(self.journal)))]
        until(lambda: all(_gone(pid) for pid in pids))
        left = [pid for pid in pids if not _gone(pid)]
        for pid in left:
            os.kill(pid, signal.SIGKILL)
        return left

    def published(self, metric: str, what: str = "message") -> list[Any]:
        lines = [json.loads(line) for line in _lines(self.record)]
        return [line for line in lines if line["topic"] == f"{BASE}/outgoing/{metric}" and line["what"] == what]

    def states(self) -> dict[str, str]:
        """What the robot says of its services just now."""
        return {name: one["state"] for name, one in self.services().items()}

    def children(self) -> dict[str, int]:
        """The living children, by the names that the kernel has for them."""
        task = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        pids = map(int, task.read_text().split())
        return {Path(f"/proc/{pid}/comm").read_text().strip(): pid for pid in pids}

    def services(self) -> dict[str, Any]:
        said = self.published("status")
        return said[-1]["payload"]["value"]["services"] if said else {}

    def ready(self, *names: str) -> bool:
        return until(lambda: all(self.states().get(name) == "ready" for name in names), 20)

    def logs(self) -> list[Any]:
        return [line["payload"] for line in self.published("logs")]

    def stderr(self) -> str:
        return self.errors.read_text()


def _config(run_dir: Path, launcher: dict[str, Any]) -> dict[str, Any]:
    return {
        "robot": {"id": "rover"},
        "transport": {"kind": "mqtt", "run_dir": str(run_dir)},
        "local_mqtt": {"password": "hush"},
        "services": {"launcher": launcher},
    }


def _lines(file: Path) -> list[str]:
    """The complete lines of a file that may still be written to."""
    return file.read_text().rpartition("\n")[0].splitlines() if file.exists() else []


def _gone(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


Launch = Callable[..., Robot]


@pytest.fixture
def launch(tmp_path: Path) -> Iterator[Launch]:
    robots: list[Robot] = []

    def make(*rows: Row, options: tuple[str, ...] = (), env: dict[str, str] | None = None, **launcher: Any) -> Robot:
        robots.append(Robot(tmp_path, list(rows), *options, env=env or {}, **launcher))
        return robots[-1]

    yield make
    for robot in robots:
        robot.process.kill()  # the children notice by themselves
        robot.process.wait(10)
        left = robot.end_leftovers()
        assert not left, f"processes that outlived their launcher: {left}"


# -- starting


def test_children_start_in_order_and_their_readiness_is_told(launch: Launch) -> None:
    robot = launch(("hub", "good", FABRIC), ("serial", "good", DEVICE), ("bridge", "good", LINK))
    assert robot.ready("hub", "serial", "bridge")
    pids = [robot.events(name, "start")[0] for name in ("hub", "serial", "bridge")]
    assert pids == sorted(pids)
    for pid in pids:
        assert b"hush" not in Path(f"/proc/{pid}/cmdline").read_bytes()
    last = robot.published("status")[-1]
    assert (last["qos"], last["retain"]) == (1, True)
    assert robot.services()["hub"] == {"state": "ready", "restarts": 0, "last_exit": None}
    (said,) = robot.published("capabilities")
    assert said["payload"]["schema"] == "pebble-capabilities/v1"
    assert said["payload"]["value"]["transport"] == {"kind": "mqtt"}
    assert (said["qos"], said["retain"]) == (1, True)


def test_kept_state_is_said_again_on_its_interval(launch: Launch) -> None:
    robot = launch(
        ("bridge", "good", LINK),
        retained_publish_interval_seconds=0.1,
        capabilities={"publish_interval_seconds": 0.1},
    )
    assert until(lambda: len(robot.published("status")) > 10 and len(robot.published("capabilities")) > 5)
    stamps = [one["payload"]["t"] for one in robot.published("capabilities")]
    assert stamps == sorted(set(stamps))


def test_what_is_switched_off_is_not_published(launch: Launch) -> None:
    robot = launch(
        ("bridge", "talker", LINK), restart_delay_seconds=0, capabilities={"enabled": False}, logs={"enabled": False}
    )
    assert until(lambda: robot.states().get("bridge") == "failed", 20)
    assert not robot.published("capabilities")
    assert not robot.published("logs")


def test_a_stop_signal_while_starting_starts_no_further_child(launch: Launch) -> None:
    robot = launch(("hub", "good", FABRIC), ("serial", "good", DEVICE), options=("signal",))
    assert robot.process.wait(20) == 0
    assert robot.stderr().count("spawned a child") == 1


def test_a_second_launcher_for_the_same_robot_is_refused(launch: Launch) -> None:
    robot = launch(("bridge", "good", LINK))
    assert robot.ready("bridge")
    second = robot.second()
    assert second.returncode == 1
    expected = f"refused: {BASE} already runs: process {robot.process.pid} holds {robot.run_dir}/launcher.lock"
    assert second.stderr.strip() == expected
    assert robot.run_dir.stat().st_mode & 0o777 == 0o700
    assert len(robot.events("bridge", "start")) == 1


def test_microcontroller_robots_are_refused(tmp_path: Path) -> None:
    config = tmp_path / "lamp.json"
    config.write_text('{"robot": {"id": "lamp", "platform": "esp32"}}')
    with pytest.raises(ConfigError, match="esp32 runs on its own MCU"):
        Launcher(load(config))


# -- keeping alive


def test_a_killed_child_is_started_again_at_once(launch: Launch) -> None:
    robot = launch(("serial", "good", DEVICE), ("bridge", "good", LINK), restart_delay_seconds=600)
    assert robot.ready("serial", "bridge")
    os.kill(robot.events("serial", "start")[0], signal.SIGKILL)
    assert until(lambda: len(robot.events("serial", "ready")) == 2, 20), "only the second restart may wait"
    again = {"state": "ready", "restarts": 1, "last_exit": "signal 9"}
    assert until(lambda: robot.services()["serial"] == again)
    assert len(robot.events("bridge", "start")) == 1


def test_a_crash_loop_is_visible_and_not_hot(launch: Launch) -> None:
    robot = launch(("serial", "crash", DEVICE), ("bridge", "good", LINK), restart_delay_seconds=0)
    assert until(lambda: robot.states().get("serial") == "failed", 20)
    assert robot.ready("bridge")
    assert len(robot.events("serial", "start")) == 5
    errors = [record for record in robot.logs() if record["level"] == "ERROR"]
    assert [error["message"] for error in errors] == [
        "[launcher] serial ended 5 times within 60 s, last: exit code 3. Trying again every 10 s"
    ]
    fared = robot.services()["serial"]
    assert fared == {"state": "failed", "restarts": 4, "last_exit": "exit code 3"}


def test_a_stuck_child_is_killed_and_started_again(launch: Launch) -> None:
    robot = launch(("serial", "mute", DEVICE), ("bridge", "good", LINK), options=("hasty",))
    assert until(lambda: len(robot.events("serial", "ready")) >= 2, 20)
    assert _gone(robot.events("serial", "ready")[0])
    assert len(robot.events("bridge", "start")) == 1
    assert until(lambda: any("serial gives no sign of life: killed" in one["message"] for one in robot.logs()))
    assert until(lambda: robot.services()["serial"]["last_exit"] == "stuck, killed")


def test_what_a_child_started_ends_with_it(launch: Launch) -> None:
    robot = launch(("player", "parent", LINK), restart_delay_seconds=600)

    def grandchildren() -> list[int]:
        return [int(pid) for pid in re.findall(r"child:(\d+)", "\n".join(_lines(robot.journal)))]

    assert until(lambda: len(grandchildren()) == 2, 20)
    assert until(lambda: all(_gone(pid) for pid in grandchildren()))


def test_a_killed_launcher_leaves_no_orphans(launch: Launch) -> None:
    robot = launch(("hub", "good", FABRIC), ("serial", "good", DEVICE))
    assert robot.ready("hub", "serial")
    pids = robot.events("hub", "start") + robot.events("serial", "start")
    robot.process.kill()
    assert until(lambda: all(_gone(pid) for pid in pids))
    assert robot.events("serial", "stop"), "children are told, so that they can stop their hardware"


@pytest.mark.parametrize("trouble", ["hangs", "broken"])
def test_supervision_does_not_wait_for_a_transport(launch: Launch, trouble: str) -> None:
    robot = launch(("serial", "good", DEVICE), options=(trouble,))
    assert until(lambda: robot.events("serial", "ready"), 20)
    os.kill(robot.events("serial", "ready")[0], signal.SIGKILL)
    assert until(lambda: len(robot.events("serial", "ready")) == 2, 20)
    assert robot.stop() == 0
    assert len(robot.events("serial", "stop")) == 1


def test_why_nothing_is_published_is_said(launch: Launch) -> None:
    robot = launch(("serial", "good", DEVICE), options=("broken",))
    said = "[ERROR] [announcer] the launcher publishes nothing: no such certificate"
    assert until(lambda: said in robot.stderr(), 20)


def test_a_killed_announcer_is_started_again_and_told_what_it_missed(launch: Launch) -> None:
    robot = launch(("serial", "good", DEVICE), retained_publish_interval_seconds=600)
    assert robot.ready("serial", "announcer")
    os.kill(robot.children()["announcer"], signal.SIGKILL)
    assert until(lambda: robot.services()["announcer"] == {"state": "ready", "restarts": 1, "last_exit": "signal 9"})
    assert len(robot.published("capabilities")) >= 2
    assert len(robot.events("serial", "start")) == 1


def test_a_stopped_announcer_disturbs_nobody_and_is_replaced(launch: Launch) -> None:
    robot = launch(("serial", "good", DEVICE), options=("hasty",))
    assert robot.ready("serial", "announcer")
    os.kill(robot.children()["announcer"], signal.SIGSTOP)
    os.kill(robot.events("serial", "start")[0], signal.SIGKILL)
    assert until(lambda: len(robot.events("serial", "ready")) == 2, 20)
    assert until(lambda: "announcer gives no sign of life: killed" in robot.stderr(), 20)
    assert until(lambda: robot.services()["serial"]["restarts"] == 1, 20)


# -- a forked process


def test_a_child_finds_what_a_fresh_interpreter_would(launch: Launch) -> None:
    robot = launch(("serial", "curious", DEVICE))
    assert robot.ready("serial")
    words = [line.split()[1] for line in _lines(robot.journal)]
    assert words[:4] == ["fds:0=null,1=pipe,2=pipe,3=pipe", "mask:", "handler:SIG_DFL", "group:True"]


def test_children_have_names(launch: Launch) -> None:
    robot = launch(("serial_mcu_bridge:arm", "good", DEVICE), ("hub", "good", FABRIC))
    assert robot.ready("serial_mcu_bridge:arm", "hub", "announcer")
    assert sorted(robot.children()) == ["announcer", "hub", "serial_mcu_brid"]


@pytest.mark.parametrize(
    ("behaviour", "how", "words"),
    [
        ("crash", "exit code 3", ""),
        ("word", "exit code 1", "[serial] a last word"),
        ("raise", "exit code 1", "[ERROR] [serial] RuntimeError: nobody catches this"),
        ("exit", "exit code 7", ""),
        ("done", "exit code 0", ""),
    ],
)
def test_the_end_of_a_program_is_the_end_of_its_process(launch: Launch, behaviour: str, how: str, words: str) -> None:
    robot = launch(("serial", behaviour, DEVICE), restart_delay_seconds=600)
    assert until(lambda: robot.services().get("serial", {}).get("last_exit") == how, 20)
    assert until(lambda: words in robot.stderr())
    assert "pebble/launcher/keeper.py" not in robot.stderr(), "nothing goes back to where the launcher was"


def test_threads_are_waited_for_before_the_exit_functions_run(launch: Launch) -> None:
    robot = launch(("serial", "done", DEVICE), restart_delay_seconds=600)
    assert until(lambda: robot.events("serial", "atexit"), 20)
    assert [line.split()[1] for line in _lines(robot.journal)][:3] == ["start", "thread", "atexit"]


def test_the_lock_of_a_killed_launcher_is_free_at_once(launch: Launch) -> None:
    robot = launch(("bridge", "stubborn", LINK))
    assert robot.ready("bridge")
    pid = robot.events("bridge", "start")[0]
    robot.process.kill()
    robot.process.wait(10)
    try:
        assert not _gone(pid)
        with RunLock(robot.run_dir, BASE):
            pass
    finally:
        os.kill(pid, signal.SIGKILL)


def test_restarts_leave_no_descriptors_behind(launch: Launch) -> None:
    robot = launch(("serial", "crash", DEVICE), options=("tireless",), restart_delay_seconds=0)
    assert robot.ready("announcer")
    assert until(lambda: len(robot.events("serial", "start")) > 3, 20)
    open_now = Path(f"/proc/{robot.process.pid}/fd")
    before = len(list(open_now.iterdir()))
    assert until(lambda: len(robot.events("serial", "start")) > 53, 60)
    assert len(list(open_now.iterdir())) <= before + 4, "one child's, at most, come and go"


def test_a_program_that_cannot_be_imported_is_its_own_trouble(launch: Launch) -> None:
    robot = launch(("bridge", "good", LINK), options=("missing",), restart_delay_seconds=600)
    assert robot.ready("bridge")
    assert until(lambda: robot.services()["missing"]["last_exit"] == "exit code 1")
    assert "No module named no_such_module" in robot.stderr()


# -- stopping


def test_stages_stop_one_after_the_other_and_nothing_is_left(launch: Launch) -> None:
    robot = launch(("hub", "good", FABRIC), ("serial", "good", DEVICE), ("bridge", "good", LINK))
    assert robot.ready("hub", "serial", "bridge")
    pids = [robot.events(name, "start")[0] for name in ("hub", "serial", "bridge")]
    assert robot.stop() == 0
    stopped = [line.split()[0] for line in _lines(robot.journal) if line.split()[1] == "stop"]
    assert stopped == ["bridge", "serial", "hub"]
    assert all(_gone(pid) for pid in pids)
    expected = {"hub": "ready", "serial": "stopped", "bridge": "stopped", "announcer": "ready"}
    assert robot.states() == expected, "who carries the news, and who tells it, can only be alive"
    (will,) = robot.published("status", "will")
    states = {name: one["state"] for name, one in will["payload"]["value"]["services"].items()}
    assert states == dict.fromkeys(expected, "stopped")
    assert will["retain"]


def test_who_ignores_the_request_to_stop_is_killed_and_takes_no_time_from_others(launch: Launch) -> None:
    robot = launch(
        ("hub", "good", FABRIC), ("serial", "good", DEVICE), ("bridge", "stubborn", LINK), shutdown_timeout_seconds=1.5
    )
    assert robot.ready("hub", "serial", "bridge")
    stubborn = robot.events("bridge", "start")[0]
    assert robot.stop() == 0
    assert _gone(stubborn)
    assert robot.events("serial", "stop"), "was asked before it was killed"
    assert robot.events("hub", "stop")
    assert "did not stop in time: bridge" in robot.stderr()


def test_a_second_signal_ends_everything_at_once(launch: Launch) -> None:
    robot = launch(("bridge", "stubborn", LINK), shutdown_timeout_seconds=600)
    assert robot.ready("bridge")
    robot.process.send_signal(signal.SIGINT)
    assert until(lambda: "[launcher] stopping" in robot.stderr())
    robot.process.send_signal(signal.SIGINT)
    assert robot.process.wait(20) == 1
    assert _gone(robot.events("bridge", "start")[0])


# -- telling


def test_childrens_lines_become_records(launch: Launch) -> None:
    robot = launch(("serial_mcu_bridge:imu", "talker", DEVICE), logs={"max_message_chars": 100})
    assert until(lambda: any(record["level"] == "ERROR" for record in robot.logs()), 20)
    assert until(lambda: any("tail" in record["message"] for record in robot.logs()), 20)
    records = [record for record in robot.logs() if record["service"] == "serial_mcu_bridge:imu"]
    first = records[0]["pid"]
    assert first == robot.events("serial_mcu_bridge:imu", "start")[0]
    said = [(r["level"], r["message"].removeprefix("[serial_mcu_bridge:imu] ")) for r in records if r["pid"] == first]
    assert said == [
        ("WARNING", "mind the gap"),
        ("INFO", "just a print"),
        ("ERROR", "it broke"),
        ("ERROR", "Traceback (most recent call last):"),
        ("ERROR", '  File "somewhere.py", line 1, in <module>'),
        ("ERROR", "ValueError: seven"),
        ("INFO", "and goes on"),
        ("INFO", "x" * (97 - len("[serial_mcu_bridge:imu] ")) + "..."),
        ("INFO", "caf\ufffd and a tail without newline"),
    ]
    assert {"t", "level", "service", "message", "logger", "pid"} == set(records[0])
    line = robot.published("logs")[0]
    assert (line["qos"], line["retain"]) == (0, False)
    assert "[DEBUG] [serial_mcu_bridge:imu] not for the public" in robot.stderr()
    assert "[ERROR] [serial_mcu_bridge:imu] ValueError: seven" in robot.stderr()


def test_systemd_hears_of_readiness_life_and_end(launch: Launch, tmp_path: Path) -> None:
    path = tmp_path / "systemd"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(path))
        systemd.settimeout(20)
        heard: list[str] = []

        def hear(text: str) -> bool:
            while text not in heard:
                heard.append(systemd.recv(1000).decode())
            return True

        robot = launch(
            ("hub", "environment", FABRIC),
            ("serial", "crash", DEVICE),
            restart_delay_seconds=0,
            env={"NOTIFY_SOCKET": str(path), "WATCHDOG_USEC": "200000"},
        )
        assert hear("READY=1")
        assert robot.events("hub", "ready"), "not before everybody has had a chance"
        assert robot.events("serial", "start")
        assert hear("STATUS=2 of 3 ready; serial failed")
        assert hear("WATCHDOG=1")
        assert robot.events("hub", "systemd:False"), "children do not speak to systemd"
        assert robot.stop() == 0
        assert hear("STOPPING=1")


# -- the table


def _table(**sections: Any) -> list[tuple[str, str, tuple[str, ...], Stage]]:
    config = _parsed(**sections)
    return [(one.name, one.module, one.arguments, one.stage) for one in programs(config)]


def _parsed(**sections: Any) -> Config:
    raw = {"robot": {"id": "rover"}, **sections}
    raw["transport"] = {"run_dir": "/run/rover", **raw.get("transport", {"kind": "mqtt"})}
    return parse(raw, folder=Path("/robots"), env={})


def test_an_mqtt_robot_has_no_hub() -> None:
    services = {
        "mqtt_bridge": {"enabled": True, "remote_mqtt": {"host": "far"}},
        "serial_mcu_bridge": {
            "enabled": True,
            "serial": {"port": "/dev/ttyACM0"},
            "instances": {"arm": {"serial": {"port": "/dev/ttyACM1"}}, "off": {"enabled": False}},
        },
    }
    assert [row[0] for row in _table(services=services)] == [
        "announcer",
        "serial_mcu_bridge",
        "serial_mcu_bridge:arm",
        "mqtt_bridge",
    ]
    arm = _table(services=services)[2]
    assert arm == ("serial_mcu_bridge:arm", "pebble.services.serial_mcu_bridge", ("None", "arm"), Stage.DEVICE)


def test_a_zenoh_robot_starts_its_hub_first() -> None:
    services = {"mqtt_bridge": {"enabled": True, "remote_mqtt": {"host": "far"}}}
    transport = {"kind": "zenoh", "journal": "kept", "lease_ms": 700, "mqtt_mirror": {}}
    table = _table(services=services, transport=transport)
    assert [row[0] for row in table] == ["zenoh_hub", "announcer", "mqtt_bridge", "mqtt_mirror"]
    name, module, (settings,), stage = table[0]
    assert (name, module, stage) == ("zenoh_hub", "pebble.hub", Stage.FABRIC)
    said = json.loads(settings)
    assert (said["run_dir"], said["lease_ms"], said["journal"]) == ("/run/rover", 700, "/robots/kept")


@pytest.mark.parametrize(
    ("sections", "modules"),
    [
        ({}, {"mqtt"}),
        ({"transport": {"kind": "zenoh"}}, {"zenoh"}),
        ({"transport": {"kind": "zenoh", "mqtt_mirror": {}}}, {"zenoh", "mqtt"}),
        (
            {
                "transport": {"kind": "zenoh"},
                "services": {"mqtt_bridge": {"enabled": True, "remote_mqtt": {"host": "far"}}},
            },
            {"zenoh", "mqtt"},
        ),
        ({"transport": {"kind": "somebodys", "settings": {}}}, set()),
    ],
)
def test_the_transports_a_robot_uses_are_known_beforehand(sections: dict[str, Any], modules: set[str]) -> None:
    assert set(transport_modules(_parsed(**sections))) == {f"pebble.transports.{kind}" for kind in modules}


def test_the_hub_process_tells_that_it_listens_and_stops_when_asked(tmp_path: Path) -> None:
    settings = json.dumps({"run_dir": str(tmp_path / "run")})
    said, notes = os.pipe()
    environment = {**os.environ, NOTIFY_FD: str(notes)}
    command = [sys.executable, "-m", "pebble.hub", settings]
    with subprocess.Popen(command, cwd=ROOT, env=environment, pass_fds=(notes,)) as hub, os.fdopen(said) as signs:
        try:
            os.close(notes)
            assert signs.readline() == "READY\n"
            assert (tmp_path / "run" / "hub.sock").exists()
            assert signs.readline() == "ALIVE\n"
            hub.terminate()
            assert hub.wait(10) == 0
        finally:
            hub.kill()
