"""The pictures of each comparison, and their files."""

from __future__ import annotations

from pathlib import Path

from pebble.bench import catalogue
from pebble.bench.plots_latency import distributions
from pebble.bench.plots_style import Picture, save
from pebble.bench.results import Results
from pebble.errors import PebbleError


def draw(results: Results, folder: Path) -> list[Path]:
    """Draws the pictures of a comparison; returns the files. Raises PebbleError if they cannot be written."""
    return [_file(picture, results, folder) for picture in pictures(results)]


def pictures(results: Results) -> list[Picture]:
    """The pictures that :func:`draw` draws, with captions; names are file names without their endings."""
    if results.bench not in catalogue.MODULES:
        return distributions(results, results.bench.replace("-", " ").capitalize())
    return [picture for one in catalogue.find(results.bench).pictures for picture in one.pictures(results)]


def _file(picture: Picture, results: Results, folder: Path) -> Path:
    path = folder / f"{picture.name}.png"
    try:
        save(picture, path, results)
    except OSError as error:
        raise PebbleError(f"{path}: {error.strerror}") from None
    return path
