"""Short runs of comparisons with whole robots, which leave nothing behind."""

from __future__ import annotations

import io
import os
import signal
import sys
import tempfile
from pathlib import Path

import pytest
from rich.console import Console

from pebble.extensions.lab.bench import bridge, cost, startup
from pebble.extensions.lab.bench.bridge import COMMANDS, CPU, DOWN, LOADED, UNLOADED, UP
from pebble.extensions.lab.bench.bridge_operator import HOP, SERVICES
from pebble.extensions.lab.bench.results import STAND_IN, Cell, Results
from pebble.extensions.lab.bench.show import Shown, finish
from pebble.extensions.lab.rig.processes import children
from pebble.extensions.lab.rig.robot import KINDS
from tests.robot.rig import Rig, descendants
from tests.support import ROOT, Child, until

pytestmark = [pytest.mark.alone, pytest.mark.thorough]  # whole robots


def written(shown: Shown, folder: Path) -> Results:
    """Return the results, once their tables were printed and their pictures drawn."""
    assert finish(shown, folder, Console(file=io.StringIO())) == 0
    return shown.results


def cell_of(results: Results, variant: str, measure: str, **params: str) -> Cell:
    cell = results.find(variant, measure, **params)
    assert cell is not None, (variant, measure, params)
    return cell


def test_startup_of_both_kinds(tmp_path: Path) -> None:
    results = written(startup.run(startup.Settings(rounds=1, joins=2), Console(file=io.StringIO())), tmp_path)
    for kind in KINDS:
        for measure in startup.STARTED:
            assert 0 < cell_of(results, kind, measure).samples[0] < 60
        for measure in startup.LATE:
            late = cell_of(results, kind, measure)
            assert len(late.samples) == 2
            assert late.total("topics") > 0
        for measure in startup.PICTURES:
            assert 0 < cell_of(results, kind, measure).samples[0] < 60_000
    assert children(os.getpid()) == []


def test_cost_of_both_kinds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cost, "_STARTUP_S", 0.0)
    results = written(cost.run(cost.Settings(seconds=0.4, rounds=1), Console(file=io.StringIO())), tmp_path)
    for kind, own in (("mqtt", "mosquitto"), ("zenoh", "zenoh_hub")):
        for phase in ("idle", "driving", *cost.STREAMS):
            for process in ("launcher", "announcer", "serial_mcu_bridge", "mqtt_bridge", "av_daemon", own):
                cell_of(results, kind, cost.MEMORY, phase=phase, process=process)
            assert cell_of(results, kind, cost.MEMORY, phase=phase, process=cost.ALL).samples[0] > 20
            assert 0 < cell_of(results, kind, cost.CPU, phase=phase, process=cost.ALL).samples[0] < 400
            assert cell_of(results, kind, cost.THREADS, phase=phase, process=cost.ALL).samples[0] > 10
        for phase in cost.STREAMS:
            assert cell_of(results, kind, cost.PICTURES, phase=phase).samples[0] > 0
    assert children(os.getpid()) == []


def test_all_robots_are_driven_also_with_media(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pebble.extensions.lab.bench.bridge_operator._STARTUP_S", 0.2)
    settings = bridge.Settings(with_media=True, seconds=1.0, rounds=1)
    results = written(bridge.run(settings, Console(file=io.StringIO())), tmp_path)
    robots = [(kind, load, way) for kind in KINDS for load in (UNLOADED, LOADED) for way in (DOWN, UP)]
    robots += [(STAND_IN, UNLOADED, way) for way in (DOWN, UP)] + [(HOP, UNLOADED, DOWN)]
    robots += [(kind, COMMANDS, DOWN) for kind in (STAND_IN, *KINDS)]
    for kind, load, way in robots:
        way_cell = cell_of(results, kind, way, load=load)
        assert len(way_cell.samples) >= 10
        assert min(way_cell.samples) > 0
    each = [cell for cell in results.cells if cell.measure == CPU]
    assert {cell.params["process"] for cell in each} == {*SERVICES}
    assert len(each) == 2 * 2 * 3
    assert all(10 < cell.samples[0] < 100_000 for cell in each)
    assert len(results.cells) == len(robots) + len(each)
    assert children(os.getpid()) == []


@pytest.mark.parametrize(("comparison", "least"), [("startup", 6), ("bridge", 12)])
def test_the_end_of_a_command_ends_its_robots(comparison: str, least: int, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pebble.cli", "bench", comparison, "--output", str(tmp_path)]
    with tempfile.TemporaryDirectory(prefix="b-", dir="/tmp") as short:  # as below it are Unix sockets
        with Child(command, cwd=ROOT, env={**os.environ, "TMPDIR": short}) as bench:
            assert until(lambda: len(descendants(bench.pid)) > least, 30), "no robot was launched"
            started = descendants(bench.pid)
            bench.send_signal(signal.SIGINT)
            assert bench.wait(60) == 130
        assert until(lambda: not any(map(Rig.alive, started)), 10)
        assert list(Path(short).iterdir()) == []
    assert not (tmp_path / f"{comparison}.json").exists()
