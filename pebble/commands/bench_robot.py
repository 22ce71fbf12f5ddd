"""``pebble bench page``: whole robots and a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pebble.commands.options import Quick, split_names


def page(
    only: Annotated[
        str | None, typer.Option(help="Some of the cases, separated by commas. [default: all]", metavar="NAMES")
    ] = None,
    tries: Annotated[int, typer.Option(min=1, help="How often each case is measured; the best time counts.")] = 3,
    wait: Annotated[float, typer.Option(min=0, help="Seconds to wait, at most, for an idle machine.")] = 0.0,
    quick: Quick = False,
    output: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("build/page"),
) -> int:
    """The operator page in a browser: what a driver feels, and what its server costs.

    From a key to the motors of a simulated robot, from whatever interrupts a driver to their stop, from the camera to
    the screen; many viewers, many robots, slow links. Needs mosquitto and its clients, chromium, the extra dev, and
    root for the links.

    \b
        pebble bench page
        pebble bench page --quick --only keys,stops
    """
    from pebble.bench.page import PagePlan, run

    names = [] if only is None else split_names(only)
    return run(PagePlan(only=names, tries=tries, wait_s=wait, quick=quick, output=output))


COMMANDS = (page,)
