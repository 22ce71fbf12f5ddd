"""``pebble bench compare``: two files of results, an older one and a newer one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def compare(
    a: Annotated[Path, typer.Argument(help="Results of the older run.", metavar="A.json", show_default=False)],
    b: Annotated[Path, typer.Argument(help="Results of the newer run.", metavar="B.json", show_default=False)],
    threshold: Annotated[float, typer.Option(help="Smaller factors are never called a change.")] = 1.05,
    everything: Annotated[bool, typer.Option("--all", help="Also what did not change.")] = False,
) -> int:
    """Did anything get worse from A to B, beyond noise? Exit code 1 if so.

    Both files come from the same comparison, best on the same machine with the same options. Medians and p99 of each
    cell are judged by an interval of their ratio that knows how much rounds differ.

    \b
        pebble bench frames --output before
        pebble bench frames --output after
        pebble bench compare before/frames.json after/frames.json
    """
    from pebble.bench.compare_report import run

    return run(a, b, threshold=threshold, everything=everything)


def register(group: typer.Typer) -> None:
    """Add the commands of this file."""
    group.command("compare")(compare)
