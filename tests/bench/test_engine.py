"""A declaration becomes a run, a command and results: order of the cases, what rounds share, failures, null tests."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
import typer
from rich.console import Console

from pebble.bench import engine
from pebble.bench.comparison import (
    MODULES,
    Budget,
    Case,
    Comparison,
    Measuring,
    Option,
    Report,
    Round,
    Run,
    find,
    of_known,
    rounds,
    seconds,
    variants,
)
from pebble.bench.judging import null
from pebble.bench.judging.aims import Aim, single, with_lost
from pebble.bench.results import OVER_TIME, Cell, Judged, Results, load
from pebble.bench.tables import COUNT, Claims, Grid, percentile_column
from pebble.commands.bench import command_of
from pebble.errors import PebbleError

SIZES = [{"size": "40 B"}, {"size": "1 KB"}]


@pytest.fixture(autouse=True)
def _no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "find_spec", lambda _name: None)


def declared(**more: Any) -> Comparison:
    given: dict[str, Any] = {
        "name": "wake-up",
        "options": (rounds("R."), seconds("S."), variants(("pipe", "socket"))),
        "full": Budget(60, rounds=2, seconds=2.0, joins=5),
        "quick": Budget(6, rounds=1, joins=3),
        "variants": ("pipe", "socket"),
        "conditions": lambda _run: SIZES,
        "measure": lambda case: [case.cell("way", "us", [100.0])],
    }
    given |= more
    measuring, report = (
        kind(**{one.name: given.pop(one.name) for one in fields(kind) if one.name in given})
        for kind in (Measuring, Report)
    )
    return Comparison(title="Waking up", what="", measuring=measuring, report=report, **given)


def measured(about: Comparison, folder: Path, **given: Any) -> Results:
    assert engine.run(about.run_of(output=folder, console=Console(file=io.StringIO(), width=100), **given)) == 0
    return load(folder / f"{about.name}.json")


def test_every_other_round_and_pass_is_reversed(tmp_path: Path) -> None:
    ran: list[tuple[str, str]] = []

    def measure(case: Case) -> Iterator[Cell]:
        ran.append((case.variant, str(case.condition["size"])))
        yield case.cell("way", "us", [float(case.number)])

    about = declared(measure=measure, full=Budget(1, rounds=2, passes=2))
    results = measured(about, tmp_path)
    there = [("pipe", "40 B"), ("socket", "40 B"), ("pipe", "1 KB"), ("socket", "1 KB")]
    assert ran == [*there, *there[::-1], *there[::-1], *there]
    assert [(cell.variant, cell.params["size"]) for cell in results.cells] == there
    assert all(cell.rounds == [[0.0, 0.0], [1.0, 1.0]] for cell in results.cells)


def test_the_command_and_the_options_repeat_a_run(tmp_path: Path) -> None:
    results = measured(declared(constants={"rate_hz": 20.0}), tmp_path, quick=True, variants=["socket"])
    assert " ".join(results.command) == "pebble bench wake-up --rounds 1 --seconds 2 --variants socket --quick"
    assert results.options == {"rounds": 1, "seconds": 2.0, "joins": 3, "rate_hz": 20.0}
    assert results.quick
    assert {cell.variant for cell in results.cells} == {"socket"}


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"rounds": 0}, "--rounds 0: must be at least 1"),
        ({"seconds": 4000.0}, "--seconds 4000.0: must be at least 0.1 and at most 3600"),
        ({"variants": ["pigeon"]}, "unknown pigeon: there are pipe, socket"),
        ({"variants": ["pipe", "pipe"]}, "each one once"),
        ({"variants": []}, "at least one"),
    ],
)
def test_an_invalid_option_is_named(given: dict[str, Any], why: str) -> None:
    with pytest.raises(PebbleError, match=why):
        declared().run_of(**given)


def test_rounds_share_an_environment_until_one_fails(tmp_path: Path) -> None:
    entered: list[int] = []

    @contextmanager
    def environment(_run: Run) -> Iterator[int]:
        entered.append(len(entered))
        yield entered[-1]

    def measure(round_: Round) -> Iterator[Cell]:
        for case in round_.cases():
            if case.number == 3:
                raise PebbleError("it broke")
            yield case.cell("way", "us", [float(case.env)])

    about = declared(measure_round=measure, environment=environment, full=Budget(1, rounds=6, fresh_every=3))
    results = measured(about, tmp_path)
    assert results.cells[0].rounds == [[0.0], [0.0], [0.0], [2.0], [2.0]]
    assert results.assessment == ["1 of 6 rounds failed and were left out; round 4: it broke"]


def test_a_case_that_fails_alone_leaves_only_its_own_round_empty(tmp_path: Path) -> None:
    def measure(case: Case) -> Iterator[Cell]:
        if (case.variant, case.number) == ("socket", 0):
            raise PebbleError("it broke")
        yield case.cell("way", "us", [1.0], sent=2)

    results = measured(declared(measure=measure, alone=True, measures=("way",)), tmp_path)
    assert [cell.rounds for cell in results.cells] == [[[1.0], [1.0]], [[], [1.0]]] * 2
    assert [cell.figures for cell in results.cells] == [{"sent": 4}, {"sent": 2}] * 2
    assert {cell.unit for cell in results.cells} == {"us"}


def test_single_values_are_joined_as_declared(tmp_path: Path) -> None:
    about = declared(
        measure=lambda case: [case.cell("way", "us", [1.0], topics=3 - case.number, last=case.number)],
        figures={"topics": max},
    )
    assert measured(about, tmp_path).cells[0].figures == {"topics": 3, "last": 1}


def test_a_curve_keeps_its_times_and_its_values(tmp_path: Path) -> None:
    curve = Cell(variant="pipe", measure=f"way{OVER_TIME}", unit="us", rounds=[[0.0, 1.0], [7.0, 8.0]])
    results = measured(declared(measure_round=lambda _round: [curve], full=Budget(1)), tmp_path)
    assert results.cells[0].rounds == [[0.0, 1.0], [7.0, 8.0]]


def test_a_cell_without_samples_exits_with_1(tmp_path: Path) -> None:
    about = declared(measure=lambda case: [case.cell("way", "us", [] if case.variant == "socket" else [1.0])])
    assert engine.run(about.run_of(output=tmp_path, console=Console(file=io.StringIO()))) == 1


def test_the_machine_is_asked_before_anything_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def measure(case: Case) -> Iterator[Cell]:
        monkeypatch.setattr("pebble.bench.results.machine", None)
        yield case.cell("way", "us", [1.0])

    assert measured(declared(measure=measure), tmp_path).machine["cpu"]


def test_an_option_may_set_a_value_of_another_name(tmp_path: Path) -> None:
    option = Option(name="way", sets="variants", many=True, known=("pipe", "socket"), help="W.")
    results = measured(declared(options=(option,)), tmp_path, variants=["socket"])
    assert " ".join(results.command) == "pebble bench wake-up --way socket"
    assert {cell.variant for cell in results.cells} == {"socket"}


def test_variants_that_cannot_be_measured_are_left_out(tmp_path: Path) -> None:
    about = declared(missing=lambda name: "no sockets here" if name == "socket" else None)
    assert {cell.variant for cell in measured(about, tmp_path).cells} == {"pipe"}
    with pytest.raises(PebbleError, match="no variant"):
        engine.run(replace(about, measuring=Measuring(missing=lambda _name: "nothing")).run_of(output=tmp_path))


def test_what_ended_a_run_early_is_raised_when_results_are_written(tmp_path: Path) -> None:
    def measure(round_: Round) -> Iterator[Cell]:
        yield from (case.cell("way", "us", [1.0]) for case in round_.cases())
        round_.run.problem = PebbleError("the run ended early: it broke")

    with pytest.raises(PebbleError, match="ended early"):
        engine.run(declared(measure_round=measure).run_of(output=tmp_path, quick=True))
    assert load(tmp_path / "wake-up.json").assessment == ["The run ended early: it broke"]


# -- null tests


@pytest.mark.parametrize(("obedient", "outcome"), [(True, "met"), (False, "missed")])
def test_a_planted_fifth_is_found_if_it_is_there(tmp_path: Path, obedient: bool, outcome: str) -> None:
    planted: list[float] = []

    def measure(case: Case) -> Iterator[Cell]:
        planted.append(case.planted_us)
        added = case.planted_us / 1000 if case.slowed and obedient else 0.0
        yield case.cell("way", "ms", [0.4 + added] * 9)

    about = declared(
        name="wake-up-null", words=("bench", "wake-up"), measure=measure, conditions=lambda _run: SIZES[:1],
        assessment=(null.assessment,), is_null=True, full=Budget(1, rounds=8, null="pipe"),
        options=(rounds("R."), Option(name="null", metavar="VARIANT", help="Only this one.")),
    )  # fmt: skip
    results = measured(about, tmp_path)
    assert [cell.variant for cell in results.cells] == list(null.roles("pipe"))
    assert planted == pytest.approx([0.0, *[80.0] * 24])  # after a pilot all roles work, in each round
    assert [aim.outcome for aim in results.aims] == [outcome]
    assert " ".join(results.command) == "pebble bench wake-up --rounds 8 --null pipe"


def test_one_thing_is_tested_at_a_time(tmp_path: Path) -> None:
    about = declared(is_null=True)
    with pytest.raises(PebbleError, match="takes one variant"):
        engine.run(about.run_of(output=tmp_path))


def test_the_variant_of_a_null_test_may_be_missing_too(tmp_path: Path) -> None:
    null_ = Option(name="null", known=("pipe", "socket"), help="Only this one.")
    about = declared(
        is_null=True, variants=(), options=(null_,), full=Budget(1, null="pipe"), conditions=lambda _run: SIZES[:1],
        missing=lambda name: "no sockets here" if name == "socket" else None,
    )  # fmt: skip
    assert {cell.variant for cell in measured(about, tmp_path).cells} == set(null.roles("pipe"))
    with pytest.raises(PebbleError, match="no variant can be measured"):
        engine.run(about.run_of(null="socket", output=tmp_path))
    with pytest.raises(PebbleError, match="--null: unknown pigeon"):
        about.run_of(null="pigeon")


def test_values_that_a_round_lacks_are_left_out() -> None:
    join = of_known(max, 1)
    assert join([1.25, None, 0.5]) == 1.2
    assert join([None]) is None


def test_references_are_measured_with_the_chosen_variants(tmp_path: Path) -> None:
    results = measured(declared(references=("memcpy",)), tmp_path, variants=["socket"])
    assert {cell.variant for cell in results.cells} == {"socket", "memcpy"}
    assert results.command[-2:] == ["--variants", "socket"]


def test_a_round_may_have_some_conditions_and_other_passes(tmp_path: Path) -> None:
    def measure(round_: Round) -> Iterator[Cell]:
        for case in round_.cases(SIZES[1:], 3):
            yield case.cell("way", "us", [1.0])

    (cell, _) = measured(declared(measure=None, measure_round=measure), tmp_path).cells
    assert (cell.params, cell.rounds) == ({"size": "1 KB"}, [[1.0, 1.0, 1.0]] * 2)


# -- the command line


def test_a_declaration_is_a_command_with_its_modes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[Run] = []
    monkeypatch.setattr(engine, "run", lambda run: ran.append(run) or 3)
    flag = Option(name="with-media", kind=bool, help="Also with media.")
    readers = Option(name="readers", kind=int, many=True, least=1, help="Readers.")
    options = (*declared().options, Option(name="sizes", kind=int, many=True, help="Bytes."), flag, readers)
    mode = declared(name="wake-up-media", options=options)
    about = declared(options=options, modes={"with-media": mode}, help="Wakes up.\n\nMore.")
    app = typer.Typer()
    app.command()(command_of(about))
    command = typer.main.get_command(app)
    words = ["--rounds", "3", "--sizes", "40,1024", "--variants", "socket", "--output", str(tmp_path)]
    assert command.main(words, standalone_mode=False) == 3
    assert (
        command.main([*words, "--with-media", "--readers", "1", "--readers", "3", "--quick"], standalone_mode=False)
        == 3
    )
    plain, media = ran
    assert (plain.comparison, media.comparison) == (about, mode)
    assert (plain["rounds"], plain["sizes"], plain["variants"], plain.output) == (3, [40, 1024], ["socket"], tmp_path)
    assert plain.options.get("readers") is None
    assert media["readers"] == [1, 3]
    assert media.command[-3:] == ["--readers", "1,3", "--quick"]
    assert "--with-media" in media.command
    with pytest.raises(PebbleError, match="not a list of numbers"):
        command.main(["--sizes", "big"], standalone_mode=False)


@pytest.mark.parametrize(
    "name", [*MODULES, "control-far", "control-null", "bridge-null", "bridge-profile", "frames-null"]
)
def test_every_comparison_is_in_its_module(name: str) -> None:
    about = find(name)
    assert about.name == name
    assert about.title


# -- tables, sentences and aims


def cells() -> list[Cell]:
    return [
        Cell(variant=variant, params={"phase": phase, "process": process}, measure="PSS", unit="MB",
             rounds=[[value + number] for number in range(8)], figures={"sent": 9})
        for phase in ("idle", "driving")
        for process, value in (("all", 30.0), ("launcher", 10.0))
        for variant, value in (("mqtt", value), ("zenoh", 2 * value))
    ]  # fmt: skip


def shown(grid: Grid) -> list[list[str]]:
    console = Console(file=io.StringIO(), width=100, record=True)
    console.print(*grid(cells()))
    return [line.split() for line in console.export_text().splitlines() if line.strip()]


def test_a_grid_has_the_variants_side_by_side_and_the_sum_last() -> None:
    grid = Grid(
        title="memory", rows=("phase", "process"), columns=(percentile_column(50), COUNT), last="all", ratio=True
    )
    title, heads, _, launcher, whole, *_ = shown(grid)
    assert title == ["memory"]
    assert heads == ["phase", "process", "mqtt", "p50", "mqtt", "n", "zenoh", "p50", "zenoh", "n", "zenoh", "/", "mqtt"]
    assert launcher[:6] == ["idle", "launcher", "13.0", "8", "23.0", "8"]
    assert whole[0] == "all"


def test_a_grid_has_variants_as_rows() -> None:
    grid = Grid(title="memory", rows=("process", "variant"), columns=(COUNT,), of=lambda c: c.params["phase"] == "idle")
    assert [line[-3:] for line in shown(grid)[3:]] == [
        ["all", "mqtt", "8"], ["zenoh", "8"], ["launcher", "mqtt", "8"], ["zenoh", "8"],
    ]  # fmt: skip


def test_claims_compare_like_with_like() -> None:
    claims = Claims(
        what="{phase}, {quantity}", of=lambda cell: cell.params["process"] == "all", quantity={"PSS": "memory"}
    )
    idle, driving = claims(cells())
    assert idle.startswith("idle, memory: zenoh takes 1.9")
    assert driving.startswith("driving, memory: zenoh takes 1.9")


def test_an_aim_is_judged_from_enough_samples_and_lost_ones_are_infinitely_late() -> None:
    aim = Aim(what="{variant}, {process}, at most {bound:g}", of=lambda cell: cell.params["phase"] == "idle",
              value=with_lost(50), at_most=40, unit="MB", least=9)  # fmt: skip
    judged = list(aim(cells()))
    assert judged[0] == Judged(what="mqtt, all, at most 40", outcome="met", measured="34.0 MB")
    assert [one.outcome for one in judged] == ["met", "missed", "met", "met"]
    (latest,) = replace(aim, value=with_lost(100), worst=True)(cells())
    assert (latest.outcome, latest.measured) == ("missed", "not at all")
    assert {one.outcome for one in replace(aim, least=10)(cells())} == {"not judged"}
    assert {one.outcome for one in replace(aim, value=single("sent"), at_most=None, at_least=9)(cells())} == {"met"}
