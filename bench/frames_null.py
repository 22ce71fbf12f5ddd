"""The null test of frames: one variant against itself, and against itself slowed by a fifth."""

from __future__ import annotations

import statistics
from typing import Any

from rich.console import Console

from pebble.bench import null
from pebble.bench.engine import finish
from pebble.bench.frames import READERS, SIZES, FramesPlan, Measured, cells_of, measure
from pebble.bench.frames_report import OURS, complete, failed_rounds, tables
from pebble.bench.frames_variants import Case, missing, parse_size
from pebble.bench.results import Stopwatch
from pebble.errors import PebbleError


def plan(*, quick: bool = False, **given: Any) -> FramesPlan:
    """The default or quick plan, with the ``given`` options replaced."""
    usual = {"rounds": 2, "seconds": 0.4} if quick else {"rounds": 30, "seconds": 0.4}
    only = {"sizes": SIZES[:1], "readers": READERS[:1], "variants": (OURS,)}
    return FramesPlan(quick=quick, **{**usual, **only, **given})


def run(plan: FramesPlan, console: Console | None = None) -> int:
    """``plan`` has one size, one number of readers and one variant. Returns 0 if all roles have enough rounds.

    The assessment says whether the comparison is sound; with too few rounds it is not judged.
    """
    console = console or Console()
    plan.check()
    if len(plan.variants) * len(plan.sizes) * len(plan.readers) != 1:
        raise PebbleError("--null takes one variant, one size and one number of readers")
    [variant] = plan.variants
    if (reason := missing(variant)) is not None:
        raise PebbleError(f"{variant} cannot run: {reason}")
    command = [word if word != "--variants" else "--null" for word in plan.command()]
    watch = Stopwatch("frames-null", command, plan.options())
    size = parse_size(plan.sizes[0])
    cases = [Case(variant, size, plan.readers[0], role) for role in null.roles(variant)]
    cells = cells_of(measure(cases, plan, console, slowdown_us))
    for figures in tables(cells):
        console.print(figures)
    words = [*null.assessment(cells), *failed_rounds(cells)]
    finish(watch.results(cells, words, quick=plan.quick), plan.output, console)
    return 0 if complete(cells, plan.rounds) else 1


def slowdown_us(case: Case, so_far: Measured) -> float:
    """A fifth of the variant's usual latency so far; in the first round the other roles run first."""
    if not null.is_slowed(case.role):
        return 0.0
    usual = [
        statistics.median(one.latencies_us)
        for other, rounds in so_far.items()
        for one in rounds
        if one is not None and one.latencies_us and not null.is_slowed(other.role)
    ]
    return null.SLOWDOWN * statistics.median(usual) if usual else 0.0
