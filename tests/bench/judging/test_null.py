"""The null test passes or misses as it should, and reports it."""

import io
import random
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from pebble.bench import engine
from pebble.bench.comparison import Case
from pebble.bench.frames import FRAMES_NULL
from pebble.bench.frames_worker import RATE_HZ
from pebble.bench.judging import null
from pebble.bench.pictures import LEAST
from pebble.bench.results import Cell, load
from pebble.errors import PebbleError


def cells(again: float = 1.0, slowed: float = 1.2, rounds: int = 10) -> list[Cell]:
    """Rounds of a few samples with a little noise."""
    noise = random.Random(1)
    return [
        Cell(
            variant=role,
            params={"size": "40 B"},
            measure="one-way",
            unit="us",
            rounds=[[factor * noise.gauss(100, 3) for _ in range(9)] for _ in range(rounds)],
        )
        for role, factor in zip(null.roles("mqtt"), (1.0, again, slowed), strict=True)
    ]


def test_roles_know_their_variant() -> None:
    plain, again, slowed = null.roles("zenoh-shm")
    assert [null.variant_of(role) for role in (plain, again, slowed)] == ["zenoh-shm"] * 3
    assert [null.is_slowed(role) for role in (plain, again, slowed)] == [False, False, True]


def test_a_passed_null_test() -> None:
    (aim,) = null.assessment(cells())
    assert aim.outcome == "met"
    assert aim.measured.startswith("mqtt again 1.01 (0.99 to 1.02)")
    assert ", mqtt +20 % 1.2" in aim.measured


@pytest.mark.parametrize(("again", "slowed"), [(1.3, 1.2), (1.0, 1.0)])
def test_a_missed_null_test(again: float, slowed: float) -> None:
    (aim,) = null.assessment(cells(again, slowed))
    assert aim.outcome == "missed"


def test_few_rounds_are_shown_and_not_judged() -> None:
    (aim,) = null.assessment(cells(1.3, 1.0, rounds=4))
    assert ": not judged (mqtt again 1." in str(aim)


def test_nothing_measured_is_not_passed() -> None:
    for nothing in ([], [Cell(variant=role, measure="x", unit="us") for role in null.roles("mqtt")]):
        (aim,) = null.assessment(nothing)
        assert aim.outcome == "not judged"


def test_a_fifth_of_what_was_usual_is_planted() -> None:
    about, condition = FRAMES_NULL, {"size": "64x48", "readers": 1}
    so_far = engine.Collected(about, null.roles("mqtt"))
    assert so_far.planted_us(condition) == 0
    times = {"mqtt": [[100.0], []], "mqtt again": [[300.0], []], "mqtt +20 %": [[9000.0]]}
    so_far.add(
        Cell(variant=role, params=condition, measure="frame", unit="us", rounds=[one])
        for role, rounds in times.items()
        for one in rounds
    )
    assert so_far.planted_us(condition) == pytest.approx(0.2 * 100)  # of all roles but the slowed one


class Processes:
    """Replaces real processes: 400 µs, a little noise, and the delay that the writer is to add, if ``obedient``."""

    def __init__(self, *, obedient: bool = True) -> None:
        self._noise, self._obedient = random.Random(1), obedient

    def __call__(self, case: Case) -> list[Cell]:
        added = case.planted_us if self._obedient and case.slowed else 0.0
        return [case.cell("frame", "us", (added + self._noise.gauss(400, 8) for _ in range(20)), sent=20)]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("obedient", "quick", "code", "outcome"),
    [
        (True, False, 0, ": met ("),
        (False, False, 0, ": missed ("),
        (False, True, 0, ": not judged ("),
    ],
)
def test_frames_against_themselves(tmp_path: Path, obedient: bool, quick: bool, code: int, outcome: str) -> None:
    printed = io.StringIO()
    about = replace(FRAMES_NULL, measuring=replace(FRAMES_NULL.measuring, measure=Processes(obedient=obedient)))
    assert engine.run(about.run_of(quick=quick, output=tmp_path, console=Console(file=printed, width=80))) == code
    results = load(tmp_path / "frames-null.json")
    assert [cell.variant for cell in results.cells] == list(null.roles("zenoh-shm"))
    assert (results.bench, results.quick) == ("frames-null", quick)
    assert "--null zenoh-shm" in " ".join(results.command)
    (aim,) = results.aims
    assert outcome in str(aim)
    assert str(aim) in printed.getvalue()


def test_one_thing_is_tested_at_a_time(tmp_path: Path) -> None:
    with pytest.raises(PebbleError, match="leave --variants out"):
        engine.run(FRAMES_NULL.run_of(variants=["mqtt", "memcpy"], output=tmp_path))
    with pytest.raises(PebbleError, match="one variant, one size"):
        engine.run(FRAMES_NULL.run_of(readers=[1, 3], output=tmp_path))


@pytest.mark.parametrize("quick", [True, False])
def test_frames_gives_enough_for_a_distribution(quick: bool) -> None:
    run = FRAMES_NULL.run_of(quick=quick)
    assert run.rounds * run["seconds"] * RATE_HZ >= 1.1 * LEAST
