"""The comparison of fleets: what ten thousand would cost, where a limit is met, commands and gaps."""

from __future__ import annotations

import io
import resource
from pathlib import Path

import pytest
from rich.console import Console

from pebble.bench import engine, fleet
from pebble.bench.fleet import FLEET, PINS, World, allow_files, at_ten_thousand, check_online, driven
from pebble.bench.pictures import pictures
from pebble.bench.results import load
from pebble.errors import PebbleError
from pebble.rig.processes import Broker
from pebble.simulation.fleet import Moved
from tests.bench import synthetic

MS = 1_000_000


def test_ten_thousand_are_reckoned_by_what_each_of_the_largest_fleet_costs() -> None:
    lines = list(at_ten_thousand(synthetic.fleet().cells))
    assert lines[0] == (
        "CPU, broker: 10.0 % with 1,000 robots, 10.0 % for each 1,000 more; 10,000 would be 100 % if it goes on so"
    )
    assert len(lines) == 4


def test_growth_is_drawn_in_a_panel_for_each_unit() -> None:
    growth, pins = pictures(synthetic.fleet())
    assert (growth.name, pins.name) == ("fleet-growth", "fleet-command-to-pins")
    cpu, memory = growth.make().axes
    assert [line.get_xydata().tolist()[-1] for line in cpu.get_lines()] == [[1000, 10], [1000, 40]]  # type: ignore[union-attr]
    assert memory.get_ylabel() == "memory (PSS), MB"


def test_wheel_speeds_identify_commands_and_the_longest_silence_counts() -> None:
    sent = {"a": [0, 100 * MS], "b": [50 * MS, 150 * MS]}
    moves = {
        "a": [Moved(2 * MS, "a", (1.0, 1.0)), Moved(104 * MS, "a", (-1.0, -1.0))],
        "b": [Moved(55 * MS, "b", (1.0, 1.0))],
    }
    found = {"sent": sent, "late": 1, "heartbeats": [[20 * MS, 120 * MS], [60 * MS]]}
    latencies, figures = driven(found, moves, {"broker": 3.0, "fleet": 4.0, "mb": 0.5})
    assert sorted(latencies) == [2.0, 4.0, 5.0]
    assert (figures["sent"], figures["late"], figures["longest_gap_s"]) == (4, 1, 0.1)


class _Log(Broker):
    def __init__(self, log: Path, text: str) -> None:
        self.log = log
        log.write_text(text)


@pytest.mark.parametrize(
    ("log", "why"),
    [
        ("", "2 of 5 robots are online: it broke"),
        ("1: Client connection from 127.0.0.1 denied access by tcpd.\n",
         "2 of 5 robots are online: the broker may open no more files: raise LimitNOFILE in its unit, or ulimit -n"),
    ],
)  # fmt: skip
def test_a_limit_of_the_broker_is_one_line(tmp_path: Path, log: str, why: str) -> None:
    with pytest.raises(PebbleError) as raised:
        check_online({"online": 2, "problem": "it broke"}, 5, _Log(tmp_path / "log", log))
    assert str(raised.value) == why


def test_a_limit_of_this_user_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    allowed = [(100, 1064)]
    monkeypatch.setattr(resource, "getrlimit", lambda _what: allowed[-1])
    monkeypatch.setattr(resource, "setrlimit", lambda _what, limits: allowed.append(limits))
    allow_files(1000)
    assert allowed[-1] == (1064, 1064)
    with pytest.raises(
        PebbleError, match="2000 robots need 2064 open files in one process, and this user may have 1064"
    ):
        allow_files(2000)


@pytest.mark.alone
@pytest.mark.thorough
@pytest.mark.parametrize("robots", [300])
def test_a_whole_fleet_is_measured(tmp_path: Path, robots: int) -> None:
    """Half of it, and all of it: stops, deaths, silence, cost, and a table and a picture of them."""
    run = FLEET.run_of(quick=True, output=tmp_path, console=Console(file=io.StringIO()), robots=[robots // 2, robots])
    assert engine.run(run) == 0, run.console.file.getvalue()  # type: ignore[attr-defined]
    found = load(tmp_path / "fleet.json")
    assert {cell.measure for cell in found.cells} == set(fleet.UNITS)
    assert not [cell for cell in found.cells if not cell.samples]
    assert found.assessment[0].startswith("CPU, broker")
    assert (tmp_path / "fleet-growth.png").exists()
    assert [cell.params["robots"] for cell in found.cells if cell.measure == PINS] == [robots // 2, robots]


@pytest.mark.alone
@pytest.mark.thorough
def test_a_broker_without_files_for_all_is_named() -> None:
    with pytest.raises(PebbleError, match="the broker may open no more files"), World(60, 1, lambda _: None, files=50):
        pass
