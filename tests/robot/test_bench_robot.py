"""Short runs of startup and cost with whole robots, which leave nothing behind."""

from __future__ import annotations

import io
import os
import signal
import sys
from pathlib import Path

import pytest
from rich.console import Console

from pebble.bench import cost, startup
from pebble.bench.bridge import BRIDGE, COMMANDS, CPU, DOWN, UNLOADED, UP
from pebble.bench.bridge_operator import STAND_IN
from pebble.bench.engine import run
from pebble.bench.results import load
from pebble.rig.processes import children
from pebble.rig.robot import KINDS
from tests.bench.found import found
from tests.robot.rig import Rig, descendants
from tests.support import ROOT, Child, until

pytestmark = [pytest.mark.alone, pytest.mark.thorough]  # whole robots


@pytest.fixture(autouse=True)
def _no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plots have tests of their own, and take as long as a robot."""
    monkeypatch.setattr("pebble.bench.pictures.draw", lambda *_: [])


def test_startup_of_both_kinds(tmp_path: Path) -> None:
    printed = io.StringIO()
    short = startup.STARTUP.run_of(rounds=1, quick=True, output=tmp_path, console=Console(file=printed, width=100))
    assert run(short) == 0
    results = load(tmp_path / "startup.json")
    assert (results.bench, results.quick) == ("startup", True)
    assert results.command == ["pebble", "bench", "startup", "--rounds", "1", "--quick"]
    assert {(cell.measure, cell.variant) for cell in results.cells} == {
        (measure, kind) for measure in startup.MEASURES for kind in KINDS
    }
    for kind in KINDS:
        heartbeat, ready, obeyed, operator, paho, service, *pictures = (
            cell for measure in startup.MEASURES if (cell := found(results, kind, measure)) is not None
        )
        assert all(0 < cell.samples[0] < 60_000 for cell in pictures)
        assert len(pictures) == len(startup.PICTURES)
        assert all(0 < cell.samples[0] < 60 for cell in (heartbeat, ready, obeyed))
        assert all(len(cell.samples) == short["joins"] for cell in (operator, paho, service))
        assert all(cell.figures["topics"] for cell in (operator, paho, service))
    assert "first drive obeyed" in printed.getvalue()
    assert children(os.getpid()) == []


def test_cost_of_both_kinds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cost, "_STARTUP_S", 0.0)
    printed = io.StringIO()
    console = Console(file=printed, width=100)
    assert run(cost.COST.run_of(rounds=1, seconds=0.4, quick=True, output=tmp_path, console=console)) == 0
    results = load(tmp_path / "cost.json")
    assert results.command == ["pebble", "bench", "cost", "--rounds", "1", "--seconds", "0.4", "--quick"]
    for kind, own in (("mqtt", "mosquitto"), ("zenoh", "zenoh_hub")):
        for phase in ("idle", "driving", "json+pcm", "h264+opus"):
            names = {
                cell.params["process"]
                for cell in results.cells
                if (cell.variant, cell.params["phase"]) == (kind, phase)
            }
            assert {"all", "launcher", "announcer", "serial_mcu_bridge", "mqtt_bridge", "av_daemon", own} <= names
            memory, cpu, threads = (
                found(results, kind, measure, phase=phase, process="all") for measure in ("PSS", "CPU", "threads")
            )
            assert memory is not None
            assert cpu is not None
            assert threads is not None
            assert memory.samples[0] > 20
            assert 0 < cpu.samples[0] < 400
            assert threads.samples[0] > 10
        for phase in ("json+pcm", "h264+opus"):
            pictures = found(results, kind, "pictures", phase=phase)
            assert pictures is not None
            assert pictures.samples[0] > 0
    assert children(os.getpid()) == []


def test_the_stand_in_carries_commands_and_reports(tmp_path: Path) -> None:
    short = BRIDGE.run_of(
        quick=True, rounds=1, seconds=1.0, variants=[STAND_IN, "mqtt"], output=tmp_path,
        console=Console(file=io.StringIO()),
    )  # fmt: skip
    assert run(short) == 0
    results = load(tmp_path / "bridge.json")
    for measure, load_ in ((DOWN, UNLOADED), (UP, UNLOADED), (DOWN, COMMANDS)):
        for kind in (STAND_IN, "mqtt"):
            cell = found(results, kind, measure, load=load_)
            assert cell is not None
            assert len(cell.samples) >= 10
    assert found(results, "mqtt", UP, load=COMMANDS) is None
    each = [cell for cell in results.cells if cell.measure == CPU]
    assert len(each) == 8
    assert all(10 < cell.samples[0] < 100_000 for cell in each)
    assert children(os.getpid()) == []


def test_the_end_of_a_command_ends_its_robots(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pebble.cli", "bench", "startup", "--output", str(tmp_path)]
    with Child(command, cwd=ROOT) as bench:
        assert until(lambda: len(descendants(bench.pid)) > 6, 30), "no robot was launched"
        started = descendants(bench.pid)
        bench.send_signal(signal.SIGINT)
        assert bench.wait(60) == 130
    assert until(lambda: not any(map(Rig.alive, started)), 10)
    assert not (tmp_path / "startup.json").exists()
