"""Finishes a comparison: prints the assessment, writes the results, draws the pictures."""

from __future__ import annotations

import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from pebble.errors import PebbleError

if TYPE_CHECKING:  # command lines import the name of the folder from here, even to show their help
    from rich.console import Console

    from pebble.bench.results import Results

FOLDER = Path("bench-results")


def check_folder(folder: Path) -> None:
    """Raises PebbleError if the folder cannot be written: before an hour of measuring, not after it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise PebbleError(f"{folder}: {error.strerror}") from None


def finish(results: Results, folder: Path, console: Console) -> None:
    """Prints the assessment, writes ``<bench>.json`` and, if matplotlib is installed, the plots."""
    for line in results.assessment:
        console.print(line, highlight=False, soft_wrap=True)
    written = [folder / f"{results.bench}.json"]
    results.save(written[0])
    if find_spec("matplotlib") is None:
        console.print("No plots: pip install 'pebble-robot[bench]'", style="dim", highlight=False)
    else:
        from pebble.bench.plots import draw

        written += draw(results, folder)
    console.print(f"Written: {', '.join(map(str, written))}", style="dim", highlight=False, soft_wrap=True)
