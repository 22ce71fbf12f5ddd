"""The pictures of each comparison, and their files."""

from __future__ import annotations

from pathlib import Path

from pebble.bench.plots_bars import amounts, costs, launches, tails
from pebble.bench.plots_impair import over_trials
from pebble.bench.plots_latency import distributions, null_ratios, ratios
from pebble.bench.plots_style import Picture, save
from pebble.bench.plots_time import over_time
from pebble.bench.plots_traffic import traffic_figures
from pebble.bench.results import Results
from pebble.errors import PebbleError

BASELINE = "mqtt"


def draw(results: Results, folder: Path) -> list[Path]:
    """Draws the pictures of a comparison; returns the files. Raises PebbleError if they cannot be written."""
    return [_file(picture, results, folder) for picture in pictures(results)]


def pictures(results: Results) -> list[Picture]:
    """The pictures that :func:`draw` draws, with captions; names are file names without their endings."""
    match results.bench:
        case "control":
            title = "Service to service"
            return [*distributions(results, title), *ratios(results, BASELINE, title)]
        case "bridge":
            title = "Operator to wheels and back"
            return [*distributions(results, title), *ratios(results, BASELINE, title)]
        case "control-null" | "bridge-null" | "frames-null":
            title = f"Null test of {results.bench.removesuffix('-null')}"
            return [*null_ratios(results, title), *distributions(results, title)]
        case "startup":
            return launches(results, "Start-up")
        case "cost":
            return costs(results, "What a robot costs")
        case "frames":
            return [*tails(results, "Frames between processes"), *distributions(results, "Frames between processes")]
        case "bridge-profile":
            return distributions(results, "Operator to wheels, hop by hop")
        case "video":
            return amounts(results, "Video at equal quality")
        case "sound":
            return amounts(results, "Sound")
        case "traffic":
            return traffic_figures(results)
        case "impair":
            return [*over_trials(results), *over_time(results)]
        case _:
            return distributions(results, results.bench.replace("-", " ").capitalize())


def _file(picture: Picture, results: Results, folder: Path) -> Path:
    path = folder / f"{picture.name}.png"
    try:
        save(picture, path, results)
    except OSError as error:
        raise PebbleError(f"{path}: {error.strerror}") from None
    return path
