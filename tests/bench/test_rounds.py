"""Failed rounds: what still counts, what is reported, and when the run is given up."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from pebble.bench import startup
from pebble.bench.bridge import BRIDGE
from pebble.bench.comparison import Budget, Case, Comparison, Measuring, Round
from pebble.bench.cost import COST, IDLE, MEMORY, cells_of
from pebble.bench.engine import run
from pebble.bench.results import Cell, Results, load
from pebble.errors import PebbleError


def attempted(outcomes: str, folder: Path, printed: io.StringIO | None = None) -> Results:
    """One round for each letter: ``x`` fails."""

    def measure(case: Case) -> Iterator[Cell]:
        if outcomes[case.number] == "x":
            raise PebbleError("the robot is not up\nits last [words]")
        yield case.cell("way", "us", [1.0])

    budget = Budget(1, rounds=len(outcomes))
    about = Comparison(
        name="wake-up",
        title="Waking up",
        what="",
        full=budget,
        quick=budget,
        measuring=Measuring(measure=measure),
    )
    code = run(about.run_of(output=folder, console=Console(file=printed or io.StringIO(), width=80)))
    results = load(folder / "wake-up.json")
    assert code == int(not results.complete)
    return results


@pytest.mark.parametrize("outcomes", [10 * ".", "..x......x", ".x", "x.", "........x"])
def test_enough_rounds_are_left(outcomes: str, tmp_path: Path) -> None:
    results = attempted(outcomes, tmp_path)
    assert results.complete
    assert len(results.cells[0].rounds) == outcomes.count(".")


@pytest.mark.parametrize("outcomes", [".x.x.x....", "x......."])
def test_too_few_rounds_are_left_where_enough_were_asked_for(outcomes: str, tmp_path: Path) -> None:
    assert not attempted(outcomes, tmp_path).complete


def test_a_failed_round_is_noted_and_shown_at_once(tmp_path: Path) -> None:
    printed = io.StringIO()
    noted = ["2 of 3 rounds failed and were left out; round 2: the robot is not up"]
    assert attempted(".xx", tmp_path, printed).assessment == noted
    assert "round 3: the robot is not up\nits last [words]" in printed.getvalue()
    assert attempted("..", tmp_path).assessment == []


@pytest.mark.parametrize("outcomes", ["x", "xx."])
def test_two_failures_at_the_start_end_the_run(outcomes: str, tmp_path: Path) -> None:
    with pytest.raises(PebbleError, match="the robot is not up"):
        attempted(outcomes, tmp_path)


# -- a robot that does not become ready costs its round, not the run


@pytest.fixture(autouse=True)
def _no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pebble.bench.engine.find_spec", lambda _name: None)


def test_startup_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    launches = iter([1.0, 2.0, None, 3.0, 4.0])

    def launch(case: Case) -> Iterator[Cell]:
        if (s := next(launches)) is None:
            raise PebbleError(f"{case.variant}: no heartbeat")
        yield case.cell("first heartbeat", "s", [s])

    def first_pictures(case: Case) -> Iterator[Cell]:
        yield case.cell("picture, json, at rest", "ms", [500.0])

    monkeypatch.setattr(startup, "launch", launch)
    monkeypatch.setattr(startup, "first_pictures", first_pictures)
    assert run(startup.STARTUP.run_of(rounds=3, output=tmp_path, console=Console(file=io.StringIO()))) == 0
    results = load(tmp_path / "startup.json")
    assert {cell.variant: cell.rounds for cell in results.cells if cell.measure == "first heartbeat"} == {
        "mqtt": [[1.0], [3.0]],
        "zenoh": [[2.0], [4.0]],
    }
    pictures = [cell for cell in results.cells if cell.measure == "picture, json, at rest"]
    assert {cell.variant: cell.rounds for cell in pictures} == {"mqtt": [[500.0]], "zenoh": [[500.0]]}
    assert results.assessment[0] == "1 of 3 rounds failed and were left out; round 2: zenoh: no heartbeat"


def test_cost_goes_on(tmp_path: Path) -> None:
    robots = iter([1.0, None, 3.0])

    def measure(case: Case) -> Iterator[Cell]:
        if (mb := next(robots)) is None:
            raise PebbleError(f"{case.variant}: a process ended")
        yield from cells_of(case, IDLE, {MEMORY: {"launcher": mb}})

    about = replace(COST, measuring=Measuring(measure=measure))
    assert run(about.run_of(rounds=3, variants=["mqtt"], output=tmp_path, console=Console(file=io.StringIO()))) == 0
    results = load(tmp_path / "cost.json")
    assert results.cells[0].rounds == [[1.0], [3.0]]
    assert results.assessment[0] == "1 of 3 rounds failed and were left out; round 2: mqtt: a process ended"


def test_the_bridge_goes_on_and_counts_no_half_of_a_round(tmp_path: Path) -> None:
    def measure(round_: Round) -> Iterator[Cell]:
        for case in round_.cases():
            if (round_.number, case.variant) == (1, "zenoh"):
                raise PebbleError("zenoh: the robot is not up after 30 s")
            yield case.cell("down", "ms", [1.0], sent=1)

    about = replace(
        BRIDGE,
        measuring=replace(BRIDGE.measuring, measure_round=measure),
        conditions=lambda _run: [{"load": "none"}],
    )
    assert run(about.run_of(rounds=3, output=tmp_path, console=Console(file=io.StringIO()))) == 0
    results = load(tmp_path / "bridge.json")
    assert {len(cell.rounds) for cell in results.cells} == {2}
    assert results.assessment[0].startswith("1 of 3 rounds failed and were left out; round 2: zenoh: ")
