"""The tables and the assessment of the bridge comparison. Pure."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from rich.table import Table

from pebble.bench.bridge_robots import FLOWS, HOP, STAND_IN
from pebble.bench.null import variant_of
from pebble.bench.ratios import LEAST_ROUNDS, paired
from pebble.bench.results import Cell, grouped
from pebble.bench.tables import (
    Grid,
    base_of,
    caveat,
    figure,
    latency_table,
    plain_table,
    sentence,
    single_column,
    spread,
)
from pebble.rig.robot import KINDS

UNLOADED, COMMANDS, LOADED = "none", "commands", "media"  # unloaded: 20 commands and 50 reports a second
DOWN, UP, CPU = "down", "up", "CPU per message"
_LEAST_IN_ROUND = 100  # samples to compare p99 by rounds: with fewer it is the maximum
_LOSS_SHOWN = 0.005
WAYS = {DOWN: "command to the wheels", UP: "report to the operator"}
SUFFIXES = {UNLOADED: "", COMMANDS: ", commands only", LOADED: ", media flowing"}
_MEANWHILE = Grid(
    title="Meanwhile", rows=("variant", "load"), heads=("robot", "load"),
    columns=(
        single_column("CPU %", "cpu_percent", ".1f"),
        *(single_column(f"{name}/s", f"{name}_per_s", ".1f") for name in FLOWS),
    ),
    of=lambda cell: cell.measure == DOWN and "cpu_percent" in cell.figures,
)  # fmt: skip


def legend(cells: Sequence[Cell]) -> Iterator[str]:
    if cells:
        yield f"{UNLOADED}: 20 commands and 50 reports a second; {COMMANDS}: the robots forward no reports"


def tables(cells: Sequence[Cell]) -> Iterator[Table]:
    """The latencies, CPU for each message, then CPU and media rates of the same time."""
    if some := [cell for cell in cells if cell.measure in WAYS]:
        baseline = STAND_IN if any(cell.variant == STAND_IN for cell in some) else variant_of(some[0].variant)
        yield latency_table("Commands down, reports up; and the load on the robot", some, baseline)
    if some := [cell for cell in cells if cell.measure == CPU]:
        yield _cpu_table(some)
    if any(map(_MEANWHILE.of, cells)):
        yield from _MEANWHILE(cells)


def _cpu_table(cells: Sequence[Cell]) -> Table:
    title = "CPU for each forwarded message: median (minimum to maximum) of the rounds"
    table = plain_table(title, ["load", "process", "robot", "us", "turns", f"/ {STAND_IN}"], left=3)
    for place, some in grouped(cells, lambda cell: tuple(map(str, cell.params.values()))).items():
        table.add_section()
        for cell, shown in zip(some, [place, *len(some) * [("", "")]], strict=False):
            base = base_of(cell, cells, STAND_IN)
            ratio = "" if base is None else str(paired(cell.rounds, base.rounds))
            table.add_row(*shown, cell.variant, spread(cell), str(len(cell.samples)), ratio)
    return table


def assessment(cells: Sequence[Cell]) -> Iterator[str]:
    """One sentence for each comparison."""
    for load, suffix in SUFFIXES.items():
        for way, words in WAYS.items():
            what, robots = f"Median, {words}{suffix}", _found(cells, way, load)
            if robots:
                yield sentence(what, robots, quantity="time")
            for plain in _found(cells, way, load, [STAND_IN]):
                yield from (sentence(what, [plain, one], quantity="time") for one in robots if plain.samples)
    for way, words in WAYS.items():
        for loaded in _found(cells, way, LOADED):
            for free in _found(cells, way, UNLOADED, [loaded.variant]):
                yield f"{free.variant}, {words}, p99: {_media_effect(loaded, free)}"
    for cell in cells:
        if cell.measure == CPU and (base := base_of(cell, cells, STAND_IN)) is not None:
            load = "commands and reports" if cell.params["load"] == UNLOADED else "commands only"
            yield sentence(f"{CPU}, {cell.params['process']}, {load}", [base, cell], quantity="CPU time")
    yield from _floor(cells)
    yield from _lost(cells)
    yield from caveat([cell for way in WAYS for cell in _found(cells, way, UNLOADED)])


def matches(measure: str, variants: Sequence[str], **params: str) -> Callable[[Cell], bool]:
    """Whether a cell has this measure, one of these variants and these parameters."""
    return lambda cell: cell.measure == measure and cell.variant in variants and params.items() <= cell.params.items()


def _found(cells: Sequence[Cell], measure: str, load: str, variants: Sequence[str] = KINDS) -> list[Cell]:
    """In the order of the variants."""
    return [cell for name in variants for cell in filter(matches(measure, [name], load=load), cells)]


def _media_effect(loaded: Cell, free: Cell) -> str:
    """Compares p99 with and without media."""
    times = f"{figure(free.percentile(99))} ms, with media {figure(loaded.percentile(99))} ms"
    rounds = [*loaded.rounds, *free.rounds]
    if min(len(loaded.rounds), len(free.rounds)) < LEAST_ROUNDS or min(map(len, rounds)) < _LEAST_IN_ROUND:
        return times
    ratio = paired(loaded.rounds, free.rounds, 99)
    return f"{times}; {ratio.words('the robot with media', 'the one without')}"


def _floor(cells: Sequence[Cell]) -> Iterator[str]:
    """The time a robot adds to one hop through a broker."""
    robots = _found(cells, DOWN, UNLOADED)
    for hop in (cell for cell in cells if cell.variant == HOP and cell.samples and robots):
        floor = hop.percentile(50)
        more = ", ".join(f"{cell.variant} {figure(cell.percentile(50) - floor)} ms more" for cell in robots)
        yield f"One hop, operator to a stock client through a broker of their own, takes {figure(floor)} ms; {more}."


def _lost(cells: Sequence[Cell]) -> Iterator[str]:
    """Reports losses above a threshold."""
    for cell in (cell for cell in cells if cell.measure in WAYS):
        lost, sent = cell.lost or 0, len(cell.samples) + (cell.lost or 0)
        if lost > _LOSS_SHOWN * sent:
            what = f"{cell.variant}, {WAYS[cell.measure]}{SUFFIXES[str(cell.params['load'])]}"
            yield f"{what}: {100 * lost / sent:.1f} % of {sent} were overtaken, or did not arrive within 1 s."


def with_excess(aim: float) -> Callable[[float], str]:
    """Formats a latency, with what it takes longer than an aim."""
    return lambda ms: f"{figure(ms)} ms" + (f", by {ms - aim:.2f} ms" if ms > aim else "")
