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
from pebble.bench.comparison import Case, Round
from pebble.bench.cost import COST, IDLE, MEMORY, cells_of
from pebble.bench.engine import Rounds, run
from pebble.bench.results import Cell, load
from pebble.errors import PebbleError


def attempted(outcomes: str, printed: io.StringIO | None = None) -> Rounds:
    """One round for each letter: ``x`` fails."""
    rounds = Rounds(len(outcomes), Console(file=printed or io.StringIO(), width=80))
    for number, outcome in enumerate(outcomes):
        with rounds.attempt(number):
            if outcome == "x":
                raise PebbleError("the robot is not up\nits last [words]")
    return rounds


@pytest.mark.parametrize("outcomes", [10 * ".", "..x......x", ".x", "x.", "........x"])
def test_enough_rounds_are_left(outcomes: str) -> None:
    assert attempted(outcomes).enough


@pytest.mark.parametrize("outcomes", [".x.x.x....", "x......."])
def test_too_few_rounds_are_left_where_enough_were_asked_for(outcomes: str) -> None:
    assert not attempted(outcomes).enough


def test_a_failed_round_is_noted_and_shown_at_once() -> None:
    printed = io.StringIO()
    assert attempted(".xx", printed).notes() == ["2 of 3 rounds failed and were left out; round 2: the robot is not up"]
    assert "round 3: the robot is not up\nits last [words]" in printed.getvalue()
    assert attempted("..").notes() == []


@pytest.mark.parametrize("outcomes", ["x", "xx."])
def test_two_failures_at_the_start_end_the_run(outcomes: str) -> None:
    with pytest.raises(PebbleError, match="the robot is not up"):
        attempted(outcomes)


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

    about = replace(COST, measure=measure)
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

    about = replace(BRIDGE, measure_round=measure)
    assert run(about.run_of(rounds=3, output=tmp_path, console=Console(file=io.StringIO()))) == 0
    results = load(tmp_path / "bridge.json")
    assert {len(cell.rounds) for cell in results.cells} == {2}
    assert results.assessment[0].startswith("1 of 3 rounds failed and were left out; round 2: zenoh: ")
