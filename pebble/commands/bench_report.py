"""``pebble bench report``: all comparisons, and a document of what they found."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(
    folder: Annotated[Path, typer.Argument(help="Where results, pictures and README.md go.", metavar="FOLDER")],
    quick: Annotated[bool, typer.Option("--quick", help="Fewer cases, and shorter: under five minutes.")] = False,
    only: Annotated[
        str | None, typer.Option(help="Some of them, separated by commas. [default: all]", metavar="NAMES")
    ] = None,
    render: Annotated[
        bool, typer.Option("--render", help="Measure nothing: write pictures and README.md anew from what is there.")
    ] = False,
) -> int:
    """Run all comparisons and pebble impair, one after the other, and write a report.

    Takes an hour. A comparison that fails does not stop the others; the exit code is 1 then. What needs root is left
    out for anybody else.

    \b
        pebble bench report docs/results
        pebble bench report build/report-quick --quick
        pebble bench report bench-results --only control,control-null
        pebble bench report docs/results --render
    """
    from pebble.bench.report import run, write
    from pebble.bench.report_plan import chosen, needs_root

    if render:
        typer.echo(f"Written: {write(folder)}")
        return 0
    names = [] if only is None else [name.strip() for name in only.split(",")]
    return run(chosen(names), folder, quick=quick, left_out=[] if names else needs_root())


def register(group: typer.Typer) -> None:
    """Add the commands of this file."""
    group.command("report")(report)
