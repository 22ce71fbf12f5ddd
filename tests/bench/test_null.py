"""The null test passes or misses as it should, and reports it."""

import io
import random
from pathlib import Path

import pytest
from rich.console import Console

from pebble.bench import frames, frames_null, null
from pebble.bench.frames_loop import RATE_HZ
from pebble.bench.frames_report import Round
from pebble.bench.frames_variants import Case, Size
from pebble.bench.plots_latency import LEAST
from pebble.bench.results import Cell, Judged, load
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
    assert null.passed(cells())
    again, slowed, aim = null.assessment(cells())
    assert str(again).endswith("equal, as expected")
    assert str(slowed).endswith("the planted 20 % were found")
    assert isinstance(aim, Judged)
    assert aim.outcome == "met"


@pytest.mark.parametrize(("again", "slowed", "missed"), [(1.3, 1.2, [True, False]), (1.0, 1.0, [False, True])])
def test_a_missed_null_test(again: float, slowed: float, missed: list[bool]) -> None:
    assert not null.passed(cells(again, slowed))
    *lines, aim = null.assessment(cells(again, slowed))
    assert [str(line).endswith("MISSED") for line in lines] == missed
    assert ": missed (" in str(aim)


def test_few_rounds_are_shown_and_not_judged() -> None:
    few = cells(1.3, 1.0, rounds=4)
    lines = [str(line) for line in null.assessment(few)]
    assert ": not judged (mqtt again 1." in lines[-1]
    assert "MISSED" not in "".join(lines)


def test_nothing_measured_is_not_passed() -> None:
    assert not null.passed([])
    assert not null.passed([Cell(variant=role, measure="x", unit="us") for role in null.roles("mqtt")])


def test_a_fifth_of_what_was_usual_is_planted() -> None:
    plain, again, slowed = (Case("mqtt", Size(64, 48), 1, role) for role in null.roles("mqtt"))
    so_far = {plain: [a_round(100), None], again: [a_round(300), a_round()], slowed: [a_round(9000)]}
    assert frames_null.slowdown_us(slowed, so_far) == pytest.approx(40)
    assert frames_null.slowdown_us(plain, so_far) == 0
    assert frames_null.slowdown_us(slowed, {slowed: []}) == 0


def a_round(*latencies_us: float) -> Round:
    return Round(
        latencies_us=latencies_us, sent=1, torn=0, fallbacks=0, cpu_writer=1, cpu_reader=1, cpu_broker=None,
        memory_writer_mb=1, memory_reader_mb=1,
    )  # fmt: skip


class Processes:
    """Replaces real processes: 400 µs, a little noise, and the delay that the writer is to add, if ``obedient``."""

    def __init__(self, *, obedient: bool = True) -> None:
        self._noise, self._obedient = random.Random(1), obedient

    def __call__(self, case: Case, _seconds: float) -> Round:
        added = case.slower_us if self._obedient else 0.0
        return a_round(*(added + self._noise.gauss(400, 8) for _ in range(20)))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("obedient", "quick", "code", "outcome"),
    [
        (True, False, 0, ": met ("),
        (False, False, 0, ": missed ("),
        (False, True, 0, ": not judged ("),
    ],
)
def test_frames_against_themselves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, obedient: bool, quick: bool, code: int, outcome: str
) -> None:
    monkeypatch.setattr(frames, "run_case", Processes(obedient=obedient))
    printed = io.StringIO()
    plan = frames_null.plan(quick=quick, output=tmp_path)
    assert frames_null.run(plan, Console(file=printed, width=80)) == code
    results = load(tmp_path / "frames-null.json")
    assert [cell.variant for cell in results.cells] == list(null.roles("zenoh-shm"))
    assert (results.bench, results.quick) == ("frames-null", quick)
    assert "--null zenoh-shm" in " ".join(results.command)
    (aim,) = results.aims
    assert outcome in str(aim)
    assert str(aim) in printed.getvalue()


def test_one_thing_is_tested_at_a_time(tmp_path: Path) -> None:
    with pytest.raises(PebbleError, match="one variant, one size"):
        frames_null.run(frames_null.plan(variants=["mqtt", "memcpy"], output=tmp_path))


@pytest.mark.parametrize("quick", [True, False])
def test_frames_gives_enough_for_a_distribution(quick: bool) -> None:
    plan = frames_null.plan(quick=quick)
    assert plan.rounds * plan.seconds * RATE_HZ >= 1.1 * LEAST


def test_a_writer_that_is_held_up_is_seen_in_every_latency() -> None:
    took = frames.run_case(Case("zenoh-shm", Size(64, 48), 1, slower_us=5000.0), 0.3).latencies_us
    assert min(took) >= 5000.0
