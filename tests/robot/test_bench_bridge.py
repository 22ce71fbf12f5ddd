"""Short runs of ``pebble bench bridge`` with whole robots, and their results."""

import io
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from pebble.bench import bridge
from pebble.bench.bridge import BRIDGE, BRIDGE_NULL, BRIDGE_PROFILE
from pebble.bench.bridge_operator import HOP, SERVICES, STAND_IN
from pebble.bench.engine import run
from pebble.bench.results import Cell, load
from pebble.errors import PebbleError
from pebble.rig.processes import children
from pebble.rig.robot import KINDS
from tests.robot.rig import Rig, descendants
from tests.support import until

pytestmark = [pytest.mark.alone, pytest.mark.thorough]


@pytest.fixture(autouse=True)
def _hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pebble.bench.engine.find_spec", lambda _name: None)  # pictures have tests of their own
    monkeypatch.setattr(bridge, "_STARTUP_S", 0.2)
    monkeypatch.setattr(bridge, "_PILOT_S", 0.2)


def test_both_robots_are_driven_also_with_media_and_leave_nothing(tmp_path: Path) -> None:
    printed = io.StringIO()
    console = Console(file=printed, width=120)
    wanted = BRIDGE.run_of(quick=True, rounds=1, seconds=0.4, output=tmp_path, console=console, **{"with-media": True})
    assert run(wanted) == 0
    results = load(tmp_path / "bridge.json")
    robots = {(kind, load_, way) for kind in KINDS for load_ in ("none", "media") for way in ("down", "up")}
    stand_in = {(STAND_IN, "none", way) for way in ("down", "up")}
    commands = {(kind, "commands", "down") for kind in (STAND_IN, *KINDS)}
    each = {(kind, load_, "CPU per message") for kind in (STAND_IN, *KINDS) for load_ in ("none", "commands")}
    wanted_cells = {*robots, *stand_in, *commands, *each, (HOP, "none", "down")}
    assert {_name(cell) for cell in results.cells} == wanted_cells
    assert {cell.params["process"] for cell in results.cells if "process" in cell.params} == {*SERVICES}
    assert {cell.figures["sent"] for cell in results.cells if cell.measure == "down"} == {8}
    assert all(min(cell.samples) > 0 for cell in results.cells)
    assert (results.quick, results.command[:3]) == (True, ["pebble", "bench", "bridge"])
    assert "zenoh" in printed.getvalue()
    assert results.aims
    assert children(os.getpid()) == []


def _name(cell: Cell) -> tuple[str, object, str]:
    return cell.variant, cell.params["load"], cell.measure


def test_one_robot_is_compared_with_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bridge, "_STARTUP_S", 0.5)  # the serial port is open, and the pilot quick
    wanted = BRIDGE_NULL.run_of(rounds=2, seconds=0.1, output=tmp_path, console=Console(file=io.StringIO()))
    assert run(wanted) == 0
    results = load(tmp_path / "bridge-null.json")
    assert [cell.variant for cell in results.cells] == ["zenoh", "zenoh again", "zenoh +20 %"]
    assert [len(cell.rounds) for cell in results.cells] == [2, 2, 2]
    assert [aim.what for aim in results.aims] == ["no difference found where there is none, and the planted 20 % found"]


def test_commands_are_traced_hop_by_hop(tmp_path: Path) -> None:
    printed = io.StringIO()
    console = Console(file=printed, width=100)
    wanted = BRIDGE_PROFILE.run_of(rounds=1, seconds=0.3, output=tmp_path, console=console)
    if os.geteuid() != 0:
        with pytest.raises(PebbleError, match="captures packets on loopback, which requires root"):
            run(wanted)
        return
    assert run(wanted) == 0
    results = load(tmp_path / "bridge-profile.json")
    assert "robot's broker" in printed.getvalue()
    for cell in results.cells:
        assert min(cell.samples) > 0, cell.params


def test_ctrl_c_ends_all_processes(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pebble.cli", "bench", "bridge", "--output", str(tmp_path / "results")]
    folders = tmp_path / "folders"
    folders.mkdir()
    with subprocess.Popen(command, env={**os.environ, "TMPDIR": str(folders)}, stdout=subprocess.DEVNULL) as program:
        assert until(lambda: len(list(folders.glob("*/run/*"))) > 0, 30)  # a robot has started
        left = descendants(program.pid)
        program.send_signal(signal.SIGINT)
        assert program.wait(30) != 0
    assert len(left) > 2
    assert until(lambda: not any(map(Rig.alive, left)), 10)
    assert list(folders.iterdir()) == []
