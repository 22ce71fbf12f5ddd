"""``pebble sim world``: one process with the MCUs of all robots, and where they are."""

from __future__ import annotations

import ctypes
import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import serial

import pebble.extensions.lab.simulation.world
from pebble.extensions.lab.simulation.trace import read_trace
from pebble.extensions.lab.simulation.world.pose_page import PoseReader, page_path
from pebble.extensions.lab.simulation.world.poses import RobotPose, Track
from pebble.extensions.lab.simulation.world.program import imu_port_path, port_path, trace_path
from tests.support import WAIT_S, Child, until

ROOM = Path(pebble.extensions.lab.simulation.world.__file__).with_name("room.json")


@pytest.fixture
def room(tmp_path: Path) -> Path:
    return Path(shutil.copy(ROOM, tmp_path / "room.json"))


def command(room: Path, *options: str) -> list[str]:
    world = [sys.executable, "-m", "pebble.cli", "sim", "world", str(room)]
    return [*world, "--folder", str(room.parent / "f"), *options]


@contextmanager
def running(room: Path, *options: str) -> Iterator[Child]:
    began = time.monotonic_ns()
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with Child(command(room, *options), text=True, **pipes) as child:
        try:
            assert until(lambda: any(track.newest.ns > began for track in tracks(room).values()))
            yield child
        finally:
            child.terminate()
            child.communicate(timeout=WAIT_S)


def tracks(room: Path) -> dict[str, Track]:
    """Empty while the world does not run."""
    try:
        return PoseReader(page_path(room)).tracks()
    except OSError:
        return {}


def poses(room: Path) -> dict[str, RobotPose]:
    return {name: track.newest.pose for name, track in tracks(room).items()}


def test_a_world_is_driven_controlled_and_ended_by_its_standard_input(room: Path) -> None:
    described = json.loads(room.read_text())
    described["robots"]["goob"]["imu"] = True
    room.write_text(json.dumps(described))
    folder = room.parent / "f"
    goob, imu = port_path(folder, "goob"), imu_port_path(folder, "goob")
    with running(room, "--trace", str(folder), "--control") as world:
        start = poses(room)
        assert start["goob"] == pytest.approx((-0.8, 0.4, -0.5236), abs=1e-4)
        with serial.Serial(str(imu), timeout=30) as line:
            assert line.read(100)
        world.stdin.write("goob place 1 -0.5 90\nfred unplug\ngoob fly\ntank reset\ngoob place 1 2\n")
        world.stdin.flush()
        assert until(lambda: poses(room)["goob"] == pytest.approx((1.0, -0.5, 1.5708), abs=1e-4))
        assert until(lambda: not port_path(folder, "fred").is_symlink())
        for complaint in ("known commands: unplug", "begin with a robot (goob, fred)", "place needs three numbers"):
            assert complaint in world.stderr.readline()
        with serial.Serial(str(goob)) as port:
            port.write(b"M 0.5 0.5\n")
            assert until(lambda: poses(room)["goob"].y > -0.4)
            assert poses(room)["goob"].x == pytest.approx(1.0, abs=0.01)
        assert poses(room)["fred"] == start["fred"]
        world.stdin.close()
        assert world.wait(30) == 0, "the end of standard input ends it"
        world.stdin, printed = None, world.stdout.read()
    assert "M 0.5 0.5" in [entry.line for entry in read_trace(trace_path(folder, "goob"))]
    assert poses(room) == {}, "nothing is left of a world that has ended"
    assert f'"serial_mcu_bridge": {{"serial":{{"port":"{port_path(folder, "fred")}"}}' in printed
    assert f'"instances":{{"imu":{{"protocol":"pebble_serial_v1","serial":{{"port":"{imu}"' in printed
    assert all(f'"device":"{room}#{name}"' in printed for name in ("goob", "fred"))


def test_a_world_that_was_killed_starts_again(room: Path) -> None:
    with running(room) as world:
        world.kill()
        world.wait(30)
    with running(room) as world:
        assert poses(room)["goob"].x == pytest.approx(-0.8)
        # a signal ends it whichever thread receives it: libraries start threads when they are imported
        tasks = sorted(int(path.name) for path in Path(f"/proc/{world.pid}/task").iterdir())
        tasks.remove(world.pid)
        assert ctypes.CDLL(None).tgkill(world.pid, tasks[0], signal.SIGTERM) == 0
        assert world.wait(30) == 0
