"""Scripts as real processes: however they end, a final stop leaves at once, and they say why in one line."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from pebble.contract.payloads import Drive
from pebble.extensions.scripts.script import EXIT_ENDED
from tests.commands.command_line import config_file
from tests.ext.scripts.script.station import Station
from tests.support import WAIT_S, Child, until

AT_ONCE_S = 1.0  # a few milliseconds, but not on a busy machine; a script that does not look is ended after two

DRIVES = re.compile(r"\d\d:\d\d:\d\d \[INFO\] run \d+ drives goob\n").fullmatch
#: For what depends on the transport: how a process ends.
BOTH = pytest.mark.parametrize("shared", ["mqtt", "zenoh"], indirect=True)


@pytest.fixture(scope="module", params=["mqtt", pytest.param("zenoh", marks=pytest.mark.thorough)])
def shared(request: pytest.FixtureRequest) -> Iterator[Station]:
    station = Station(request.param)
    yield station
    station.close()


@pytest.fixture
def station(shared: Station) -> Station:
    """Nothing was received, and the motor owner is free."""
    shared.publish_state()
    shared.received.clear()
    return shared


def ended(script: subprocess.Popen[str]) -> tuple[int, str]:
    """Its exit code, and what it has printed but that it drives."""
    lines = script.communicate(timeout=WAIT_S)[0].splitlines(keepends=True)
    return script.returncode, "".join(line for line in lines if not DRIVES(line))


def ended_by_signal(script: subprocess.Popen[str]) -> str:
    """What it has printed."""
    script.terminate()
    code, output = ended(script)
    assert code in (128 + signal.SIGTERM, -signal.SIGALRM), output  # the latter: two seconds of a busy machine
    return output


@BOTH
@pytest.mark.parametrize(
    ("body", "code"),
    [
        ("robot.drive(z=0.5)", 0),
        ("robot.drive(z=0.5)\nsys.exit(7)", 7),
        ("robot.drive(z=0.5)\nraise ValueError('no such tag')", 1),
        ("robot.drive(z=0.5)\nif os.fork():\n    os.wait()", 0),
    ],
    ids=["returns", "sys.exit", "raises", "forks"],
)
def test_a_script_that_ends_stops_the_wheels(station: Station, body: str, code: int) -> None:
    found, output = ended(station.start(body))
    assert found == code, output
    assert until(station.rests)
    stop = station.received[-1].drive
    assert (stop.source, stop.run) == ("autonomy", station.received[0].drive.run)
    assert [received.drive.moves for received in station.received].count(False) == 1


@BOTH
@pytest.mark.alone
@pytest.mark.parametrize(
    "body",
    ["while True: pass", "import ctypes\nctypes.CDLL(None).poll(None, 0, 60_000)", "robot.sleep(60)"],
    ids=["busy", "blocked in C", "waiting for the robot"],
)
def test_a_signal_stops_the_wheels_whatever_the_script_does(station: Station, body: str) -> None:
    script = station.driven(f"robot.drive(z=0.5)\n{body}")
    began = time.monotonic()
    script.terminate()
    assert until(station.rests)
    assert station.received[-1].at - began < AT_ONCE_S


@pytest.mark.alone
def test_a_script_that_does_not_look_ends_2_s_after_the_signal(station: Station) -> None:
    script = station.driven("robot.drive(z=0.5)\nwhile True:\n    try: robot.drive(z=0.5)\n    except SystemExit: pass")
    script.terminate()
    began = time.monotonic()
    assert ended(script)[0] == 128 + signal.SIGTERM
    assert time.monotonic() - began > 1.0
    assert until(station.rests)


def test_ctrl_c_ends_it_without_a_word(station: Station) -> None:
    script = station.driven("robot.drive(z=0.5)\nrobot.sleep(60)")
    script.send_signal(signal.SIGINT)
    assert ended(script) == (130, "")
    assert until(station.rests)


def test_a_fork_is_no_script(station: Station) -> None:
    """A signal to it does not end the script, and it cannot drive."""
    body = """
child = os.fork()
if not child:
    try: robot.drive(z=0.9)
    except Exception as error: print(error)
    sys.stdout.flush()
    time.sleep(60)
time.sleep(0.2)
os.kill(child, 15)
print(os.wait()[1], robot.drive(z=0.5))
robot.sleep(60)"""
    script = station.driven(f"robot.drive(z=0.1){body}")
    assert until(lambda: station.received[-1].drive.z == 0.5)
    assert ended_by_signal(script).splitlines() == [
        "a fork of a script has no robot: use a thread, or start a program with subprocess", "15 True"
    ]  # fmt: skip
    assert 0.9 not in [received.drive.z for received in station.received]


def test_a_run_that_is_ended_at_the_motors(station: Station) -> None:
    script = station.driven("while robot.drive(z=0.5): time.sleep(0.02)\ntime.sleep(0.3)\nrobot.sleep(60)", run=17)
    station.publish_state(latched=True, count=1, by="anna")
    code, output = ended(script)
    assert code == EXIT_ENDED
    assert "[WARNING] emergency stop by anna\n" in output


@BOTH
def test_of_two_runs_the_newer_one_drives(station: Station) -> None:
    loop = "while True:\n    print(robot.drive(z=0.5), robot.why_refused)\n    robot.sleep(0.05)"
    older = station.driven(loop)
    newer = station.driven(loop)
    code, output = ended(older)
    assert code == EXIT_ENDED
    assert output.endswith("[WARNING] superseded: a newer run drives the robot\n")
    before = len(station.received)
    assert until(lambda: len(station.received) > before + 3)
    last = {"True a signal"}  # if it has just sent a command when the signal comes
    assert set(ended_by_signal(newer).splitlines()) - last == {"True "}


def test_a_person_goes_first(station: Station) -> None:
    script = station.driven("while True:\n    print(robot.drive(z=0.5), robot.overridden)\n    robot.sleep(0.05)")
    station.publish_drive(Drive(x=0.1))
    assert script.stdout is not None
    lines = [next(script.stdout) for _ in range(17)]  # it goes on trying
    assert DRIVES(lines[0]) or DRIVES(lines[1])
    assert sum("[WARNING] goob does not obey this script: a person drives" in line for line in lines) == 1
    assert "False True\n" in lines
    before = len(station.received)
    station.publish_drive(Drive())
    assert any(re.search(r"\[INFO\] run \d+ drives goob again", next(script.stdout)) for _ in range(200))
    ended_by_signal(script)
    assert until(station.rests)
    assert len(station.received) > before + 1


def test_a_robot_that_is_not_up_is_named_in_one_line(tmp_path: Path) -> None:
    config = config_file(tmp_path, transport={"kind": "mqtt"}, local_mqtt={"host": "127.0.0.1", "port": 1})
    (script := tmp_path / "away.py").write_text("from pebble import run\nrun(lambda robot: None)\n")
    command = [sys.executable, str(script), "--config", str(config)]
    code, output = ended(Child(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True))
    assert code == 1
    last = output.splitlines()[-1]
    assert "[ERROR] goob is not up" in last
    assert last.endswith(f"start it with `pebble up {config}`")


# -- a program that imports pebble pays for what it uses, and not for scripts


def modules_after(statement: str) -> set[str]:
    code = f"import sys; {statement}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_pebble_alone_is_nothing_but_its_version() -> None:
    loaded = {name for name in modules_after("import pebble") if name.startswith("pebble")}
    assert loaded == {"pebble", "pebble.public_names", "pebble.version"}


def test_scripts_bring_a_transport_or_pictures_only_when_they_use_them() -> None:
    loaded = modules_after("from pebble import Robot, run, Stopped, Channel, Kind")
    assert "pebble.extensions.scripts.script.program" in loaded
    assert loaded.isdisjoint({"zenoh", "paho", "numpy", "cv2", "pebble.extensions.media.cameras"})
