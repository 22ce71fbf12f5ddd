"""The launcher as a real process, with real children that misbehave in every way a child can."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from pebble.config import Config, parse
from pebble.launcher.programs import programs, shared_modules
from pebble.launcher.run_lock import RunLock
from tests.fakes.seccomp import CALLS
from tests.launcher.conftest import BASE, CONNECTION, DEVICE, LOCAL_TRANSPORT, Launch, lines_of
from tests.support import ROOT, WAIT_S, gone, until


def test_children_start_in_order_and_stop_one_stage_after_the_other_and_nothing_is_left(launch: Launch) -> None:
    stages = {"hub": LOCAL_TRANSPORT, "serial": DEVICE, "bridge": CONNECTION}
    robot, names = launch(*((name, "good", stage) for name, stage in stages.items())), tuple(stages)
    assert robot.ready(*names)
    pids = [robot.events(name, "start")[0] for name in names]
    assert pids == sorted(pids)
    for pid in pids:
        assert b"hush" not in Path(f"/proc/{pid}/cmdline").read_bytes()
    last = robot.published("status")[-1]
    assert (last["qos"], last["retain"]) == (1, True)
    assert robot.services()["hub"] == {"state": "ready", "restarts": 0, "last_exit": None}
    (message,) = robot.published("capabilities")
    assert message["payload"]["schema"] == "pebble-capabilities/v1"
    assert message["payload"]["value"]["transport"] == {"kind": "mqtt"}
    assert (message["qos"], message["retain"]) == (1, True)
    began = time.monotonic()
    assert robot.stop() == 0
    assert time.monotonic() - began < 2.0, "it waits for nothing that has ended"
    stopped = [line.split()[0] for line in lines_of(robot.journal) if line.split()[1] == "stop"]
    assert stopped == ["bridge", "serial", "hub"]
    assert all(gone(pid) for pid in pids)
    expected = {"hub": "ready", "serial": "stopped", "bridge": "stopped", "announcer": "ready"}
    assert robot.states() == expected, "who carries the news, and who tells it, can only be alive"
    (will,) = robot.published("status", "will")
    states = {name: one["state"] for name, one in will["payload"]["value"]["services"].items()}
    assert states == dict.fromkeys(expected, "stopped")
    assert will["retain"]


def test_a_stop_signal_while_starting_starts_no_further_child(launch: Launch) -> None:
    robot = launch(("hub", "good", LOCAL_TRANSPORT), ("serial", "good", DEVICE), options=("signal",))
    assert robot.process.wait(WAIT_S) == 0
    assert robot.stderr().count("spawned a child") == 1


def test_a_killed_child_is_started_again_at_once_with_the_config_of_its_launcher(launch: Launch) -> None:
    robot = launch(("serial", "configured", DEVICE), ("bridge", "good", CONNECTION), restart_delay_seconds=600)
    assert robot.ready("serial", "bridge")
    robot.config.write_text('{"robot": {"id": "another"}, "transport": {"kin')
    os.kill(robot.events("serial", "start")[0], signal.SIGKILL)
    assert until(lambda: len(robot.events("serial", "ready")) == 2), "only the second restart may wait"
    again = {"state": "ready", "restarts": 1, "last_exit": "signal 9", "restarts_per_minute": 1}
    assert until(lambda: robot.services()["serial"] == again)
    assert len(robot.events("serial", f"config:{BASE}")) == 2
    assert len(robot.events("bridge", "start")) == 1


@pytest.mark.skipif(not CALLS, reason="the numbers of system calls of this machine are not known")
@pytest.mark.parametrize(
    ("call", "error", "named"),
    [
        ("pidfd_open", "ENOSYS", ["pidfd_open is denied here (Function not implemented)"]),
        ("eventfd2", "EPERM", []),
        ("prctl", "EPERM", []),  # then nothing ends with a launcher that is killed
        ("setpgid", "EPERM", []),
    ],
)
def test_a_robot_runs_where_a_system_call_is_denied(launch: Launch, call: str, error: str, named: list[str]) -> None:
    robot = launch(("serial", "good", DEVICE), ("bridge", "good", CONNECTION), options=(f"deny {call} {error}",))
    assert robot.ready("serial", "bridge")
    os.kill(robot.events("serial", "start")[0], signal.SIGKILL)
    assert until(lambda: len(robot.events("serial", "ready")) == 2)
    assert robot.stop() == 0
    assert robot.stderr().count("is denied") == len(named)
    assert all(text in robot.stderr() for text in named)


def test_a_crash_loop_is_visible_and_not_hot(launch: Launch) -> None:
    robot = launch(("serial", "crash", DEVICE), ("bridge", "good", CONNECTION), restart_delay_seconds=0)
    assert until(lambda: robot.states().get("serial") == "failed")
    assert robot.ready("bridge")
    assert len(robot.events("serial", "start")) == 5
    assert "serial ended (exit code 3), 3 times within a minute: starting it again" in robot.stderr()
    errors = [record for record in robot.logs() if record["level"] == "ERROR"]
    assert [error["message"] for error in errors] == [
        "[launcher] serial ended 5 times within 60 s, last: exit code 3. Trying again every 10 s"
    ]
    reported = robot.services()["serial"]
    assert reported == {"state": "failed", "restarts": 4, "last_exit": "exit code 3", "restarts_per_minute": 5}


def test_a_stuck_child_is_killed_and_started_again(launch: Launch) -> None:
    robot = launch(("serial", "mute", DEVICE), ("bridge", "good", CONNECTION), options=("hasty",))
    assert until(lambda: len(robot.events("serial", "ready")) >= 2)
    assert gone(robot.events("serial", "ready")[0])
    assert len(robot.events("bridge", "start")) == 1
    assert until(lambda: any("serial gives no sign of life: killed" in one["message"] for one in robot.logs()))
    assert until(lambda: robot.services()["serial"]["last_exit"] == "stuck, killed")


def test_a_robot_that_stood_still_as_a_whole_goes_on_with_the_same_processes(launch: Launch, tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "systemd"))
        systemd.settimeout(20)
        robot = launch(
            *(("serial", "good", DEVICE), ("bridge", "good", CONNECTION)),
            options=("hasty",),
            env={"NOTIFY_SOCKET": str(tmp_path / "systemd"), "WATCHDOG_USEC": "1200000000"},  # its next turn is far off
        )
        assert robot.ready("serial", "bridge", "announcer")
        children = robot.children()
        everything = [robot.process.pid, *children.values()]
        for pid in everything:
            os.kill(pid, signal.SIGSTOP)
        time.sleep(3.5)  # longer than a hasty launcher waits for a sign of life
        os.kill(robot.process.pid, signal.SIGCONT)
        assert until(lambda: re.search("stood still|sign of life", robot.stderr())), "no child runs yet"
        assert "sign of life" not in robot.stderr()
        for pid in everything:
            os.kill(pid, signal.SIGCONT)
        assert "WATCHDOG=1" in iter(lambda: systemd.recv(1000).decode(), ""), "systemd's clock has run on"
    ready = len(robot.events("serial", "ready"))
    os.kill(children["serial"], signal.SIGKILL)
    assert until(lambda: len(robot.events("serial", "ready")) > ready)
    assert {**robot.children(), "serial": 0} == {**children, "serial": 0}


def test_a_robot_whose_run_directory_another_takes_stops_in_order(launch: Launch, tmp_path: Path) -> None:
    robot = launch(("bridge", "good", CONNECTION))
    assert robot.ready("bridge")
    shutil.rmtree(robot.run_dir)
    with RunLock(robot.run_dir, "x/y/another", tmp_path / "another.lock"):
        assert robot.process.wait(WAIT_S) == 1
    assert robot.events("bridge", "stop")


@pytest.mark.parametrize("trouble", ["hangs", "broken"])
def test_supervision_does_not_wait_for_a_transport(launch: Launch, trouble: str) -> None:
    robot = launch(("serial", "good", DEVICE), options=(trouble,))
    assert until(lambda: robot.events("serial", "ready"))
    os.kill(robot.events("serial", "ready")[0], signal.SIGKILL)
    assert until(lambda: len(robot.events("serial", "ready")) == 2)
    assert robot.stop() == 0
    assert len(robot.events("serial", "stop")) == 1


def test_a_child_finds_what_a_fresh_interpreter_would_and_has_a_name(launch: Launch) -> None:
    robot = launch(("serial_mcu_bridge:arm", "curious", DEVICE))
    assert robot.ready("serial_mcu_bridge:arm", "announcer")
    output = [line.split()[1] for line in lines_of(robot.journal)]
    assert output[:4] == ["fds:0=null,1=pipe,2=pipe,3=pipe", "mask:", "handler:SIG_DFL", "group:True"]
    assert sorted(robot.children()) == ["announcer", "serial_mcu_brid"]


def test_a_program_ends_as_a_process_of_its_own_does(launch: Launch) -> None:
    """With its exit code and its last words, after its threads and its exit functions, and its children end with it."""
    ends = {
        "crash": ("exit code 3", ""),
        "word": ("exit code 1", "[word] a last word"),
        "raise": ("exit code 1", "[ERROR] [raise] RuntimeError: nobody catches this"),
        "done": ("exit code 0", ""),
    }
    robot = launch(*((name, name, DEVICE) for name in (*ends, "parent")), restart_delay_seconds=600)
    for name, (how, output) in ends.items():
        assert until(lambda: robot.services().get(name, {}).get("last_exit") == how), name  # noqa: B023
        assert until(lambda: output in robot.stderr())  # noqa: B023
    assert "pebble/launcher/process_supervisor.py" not in robot.stderr(), "nothing goes back to where the launcher was"
    noted = [line.split()[1] for line in lines_of(robot.journal) if line.startswith("done ")]
    assert noted[:3] == ["start", "thread", "atexit"]

    def grandchildren() -> list[int]:
        return [int(pid) for pid in re.findall(r"child:(\d+)", "\n".join(lines_of(robot.journal)))]

    assert until(lambda: len(grandchildren()) == 2)
    assert until(lambda: all(gone(pid) for pid in grandchildren()))


def test_restarts_leave_no_descriptors_behind(launch: Launch) -> None:
    robot = launch(("serial", "crash", DEVICE), options=("tireless",), restart_delay_seconds=0)
    assert robot.ready("announcer")
    assert until(lambda: len(robot.events("serial", "start")) > 3)
    open_now = Path(f"/proc/{robot.process.pid}/fd")
    before = len(list(open_now.iterdir()))
    assert until(lambda: len(robot.events("serial", "start")) > 53, 60)
    assert until(lambda: len(list(open_now.iterdir())) <= before + 4), "one child's, at most, come and go"


def test_a_program_that_does_not_stop_is_killed_and_takes_no_time_from_others(launch: Launch) -> None:
    robot = launch(
        ("hub", "good", LOCAL_TRANSPORT),
        ("serial", "good", DEVICE),
        ("bridge", "stubborn", CONNECTION),
        shutdown_timeout_seconds=1.5,
    )
    assert robot.ready("hub", "serial", "bridge")
    stubborn = robot.events("bridge", "start")[0]
    assert robot.stop() == 0
    assert gone(stubborn)
    assert robot.events("serial", "stop"), "was asked before it was killed"
    assert robot.events("hub", "stop")
    assert "did not stop in time: bridge" in robot.stderr()


def test_a_program_that_ends_while_the_robot_stops_is_not_started_again(launch: Launch) -> None:
    """All its processes may get the signal, by a service manager or `pkill`, and one may have just crashed."""
    robot = launch(
        ("hub", "good", LOCAL_TRANSPORT),
        ("serial", "crash", DEVICE),
        ("bridge", "stubborn", CONNECTION),
        shutdown_timeout_seconds=600,
        restart_delay_seconds=2,
    )
    assert robot.ready("hub", "bridge")
    robot.process.send_signal(signal.SIGINT)
    assert until(lambda: "[launcher] stopping" in robot.stderr())
    crashes = robot.stderr().count("again in")
    os.kill(robot.events("hub", "start")[0], signal.SIGKILL)
    assert until(lambda: "hub ended (signal 9) before its turn to stop" in robot.stderr())
    assert until(lambda: robot.states().get("serial") == "stopped"), "it was waiting for its next start"
    os.kill(robot.events("bridge", "start")[0], signal.SIGKILL)
    assert robot.process.wait(WAIT_S) == 0
    assert robot.stderr().count("again in") == crashes
    assert len(robot.events("hub", "start")) == 1


def test_systemd_is_notified_of_readiness_life_and_end(launch: Launch) -> None:
    address = f"@pebble-test-{os.getpid()}"  # an abstract one
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(address.replace("@", "\0"))
        systemd.settimeout(20)
        received: list[str] = []

        def notified(text: str) -> bool:
            while text not in received:
                received.append(systemd.recv(1000).decode())
            return True

        robot = launch(
            ("hub", "environment", LOCAL_TRANSPORT),
            ("serial", "crash", DEVICE),
            restart_delay_seconds=0,
            logs={"enabled": False},
            env={"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "200000"},
        )
        assert notified("READY=1")
        assert robot.events("hub", "ready"), "not before every program has been started"
        assert robot.events("serial", "start")
        assert notified("STATUS=2 of 3 ready; serial failed")
        assert notified("WATCHDOG=1")
        assert robot.events("hub", "systemd:False"), "children do not speak to systemd"
        assert robot.stop() == 0
        assert notified("STOPPING=1")
        assert not robot.published("logs"), "they are switched off"


ON, OFF = {"enabled": True}, {"enabled": False}
UPLINK = {"enabled": True, "remote_mqtt": {"host": "far"}}
ARM = {"arm": {"serial": {"port": "/dev/ttyACM1"}}, "off": OFF}
LINES = {"enabled": True, "serial": {"port": "/dev/ttyACM0"}, "instances": ARM}
ZENOH = {"kind": "zenoh", "journal": "kept", "lease_ms": 700, "mqtt_mirror": {}}
MQTT = {"kind": "mqtt"}
STREAM = {"enabled": True, "command": ["mediamtx"]}
#: The services of a config, its transport, and the programs in their order; those on demand have a "+".
TABLES: dict[str, tuple[dict[str, Any], dict[str, Any], str]] = {
    "serial lines": (
        *({"mqtt_bridge": UPLINK, "serial_mcu_bridge": LINES}, MQTT),
        "announcer serial_mcu_bridge serial_mcu_bridge:arm mqtt_bridge",
    ),
    "zenoh": ({"mqtt_bridge": UPLINK}, ZENOH, "zenoh_hub mqtt_bridge mqtt_mirror"),
    "camera and microphone": (
        *({"av_daemon": ON, "mqtt_bridge": UPLINK}, MQTT),
        "announcer av_daemon mqtt_bridge +camera_publisher +audio_publisher +audio_receiver",
    ),
    "no microphone": (
        *({"av_daemon": {**ON, "audio": OFF}, "mqtt_bridge": UPLINK}, MQTT),
        "announcer av_daemon mqtt_bridge +camera_publisher",
    ),
    "no bridge": ({"av_daemon": ON, "mqtt_bridge": OFF}, MQTT, "announcer av_daemon"),
    "a foreign streaming program": (
        *({"mqtt_bridge": UPLINK, "video_stream": STREAM}, MQTT),
        "announcer mqtt_bridge +video_stream",
    ),
    "a page": ({"web_handler": ON}, MQTT, "announcer web_handler"),
}


def _parsed(services: dict[str, Any], transport: dict[str, Any] = MQTT) -> Config:
    raw = {"robot": {"id": "rover"}, "transport": {"run_dir": "/run/rover", **transport}, "services": services}
    return parse(raw, folder=Path("/robots"), env={})


@pytest.mark.parametrize(("services", "transport", "names"), TABLES.values(), ids=TABLES)
def test_a_robot_has_the_programs_of_its_config(
    services: dict[str, Any], transport: dict[str, Any], names: str
) -> None:
    assert ["+" * one.on_demand + one.name for one in programs(_parsed(services, transport))] == names.split()


#: Of a robot with a camera, a text protocol on its serial line, and the security level `open`.
NEEDED = ["numpy", "pebble.runtime.process", "pebble.extensions.fleet.robot_audit"]
NOT_NEEDED = ["cv2", "av", "subprocess", "pebble.services.mqtt_bridge.stop_connection", "pebble.runtime.hub"]


def test_the_launcher_of_a_robot_with_a_camera_imports_only_what_several_share_and_stays_single_threaded() -> None:
    line = {"enabled": True, "serial": {"port": "/dev/x"}}
    config = _parsed({"av_daemon": ON, "mqtt_bridge": UPLINK, "serial_mcu_bridge": line})
    shared = shared_modules(config, programs(config))
    code = f"""
import os, sys
from pebble.launcher import launcher
from pebble.launcher.programs import preload
preload([*{shared}, "pebble.transports.mqtt.transport", "pebble.transports.zenoh.transport"])
print([name for name in {(*NEEDED, *NOT_NEEDED)} if name in sys.modules], len(os.listdir("/proc/self/task")))
"""
    ran = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert ran.stdout.strip() == f"{NEEDED} 1", ran.stderr
