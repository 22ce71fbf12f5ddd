"""Prints what changed between two result files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from pebble.bench.compare import THRESHOLD, Finding, Kind, compare, differences, summary
from pebble.bench.results import load
from pebble.bench.tables import figure, plain_table
from pebble.errors import PebbleError

_COLOURS = {
    Kind.NO_SAMPLES: "red",
    Kind.WORSE: "red",
    Kind.ONLY_A: "yellow",
    Kind.ONLY_B: "yellow",
    Kind.BETTER: "green",
}


def run(
    a: Path, b: Path, *, threshold: float = THRESHOLD, everything: bool = False, console: Console | None = None
) -> int:
    """0 if nothing got worse, 1 if something did. Raises PebbleError for files that cannot be compared."""
    console = console or Console()
    if not (math.isfinite(threshold) and threshold >= 1):
        raise PebbleError(
            f"--threshold {threshold:g}: a factor of 1 or more is needed (1.05 ignores changes below 5 %)"
        )
    before, after = load(a), load(b)
    if before.bench != after.bench:
        raise PebbleError(
            f"{a} is of bench {before.bench}, {b} of bench {after.bench}: compare two runs of the same bench"
        )
    for line in differences(before, after):
        console.print(f"not the same: {line}", style="yellow", highlight=False, markup=False, soft_wrap=True)
    with console.status("comparing"):  # hundreds of intervals take a few seconds
        findings = compare(before, after, threshold)
    shown = [finding for finding in findings if everything or finding.changed]
    if shown:
        console.print(_table(shown, before.bench))
    for line in summary(findings, threshold):
        console.print(line, highlight=False, soft_wrap=True)
    return int(any(finding.worse for finding in findings))


def _table(findings: Sequence[Finding], bench: str) -> Table:
    table = plain_table(f"{bench}: B against A", ("what", "metric", "A", "B", "B / A", ""), left=2)
    table.columns[0].no_wrap = False  # long names wrap, so that the outcome is never cut off
    for finding in findings:
        cell = finding.cell
        table.add_row(
            ", ".join(filter(None, (cell.variant, cell.measure, cell.conditions()))),
            finding.what,
            figure(finding.a),
            figure(finding.b),
            str(finding.ratio),
            finding.kind,
            style=_COLOURS.get(finding.kind),
        )
    table.columns[-1].justify = "left"
    return table
