"""Pictures of latency over time, with the trials marked."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pebble.bench.plots_style import Picture, around, finite, log_axis, panels, short, styles
from pebble.bench.results import OVER_TIME, Cell, Results

_BANDS = ("#f3f0e7", "#ffffff")


def over_time(results: Results) -> list[Picture]:
    """One picture for each measure ``… over time``, whose cells hold two rounds: seconds, and milliseconds."""
    found = []
    for measure in dict.fromkeys(cell.measure for cell in results.cells if cell.measure.endswith(OVER_TIME)):
        what = measure.removesuffix(OVER_TIME)
        cells = [
            cell
            for cell in results.cells
            if cell.measure == measure and len(cell.rounds) == 2 and finite(cell.rounds[0])
        ]
        caption = f"Latency of {what} over time, with the trials marked: a dot for each message that arrived"
        if cells:
            name = f"{results.bench}-{what}-over-time"
            found.append(Picture(name, caption, lambda c=cells, t=caption: _series(c, results, t)))  # type: ignore[misc]
    return found


def marks(text: str) -> list[tuple[str, float]]:
    """Parses ``256k@37.2;512k@60`` into names and seconds; skips invalid parts."""
    found = []
    for part in text.split(";"):
        name, _, second = part.rpartition("@")
        try:
            found.append((name.strip(), float(second)))
        except ValueError:
            continue
    return sorted(found, key=lambda mark: mark[1])


def _series(cells: Sequence[Cell], results: Results, title: str) -> Figure:
    figure, every = panels(len(cells), 1, (12.0, 2.1), title)
    style_of = styles([cell.variant for cell in cells])
    begun = marks(str(results.options.get("marks", "")))
    ends = around([latency for cell in cells for latency in cell.rounds[1]])
    last = max(second for cell in cells for second in finite(cell.rounds[0]))
    for axes, cell in zip(every, cells, strict=True):
        seconds, latencies = cell.rounds[0], cell.rounds[1]
        _bands(axes, begun, last, named=axes is every[0])
        axes.plot(seconds, latencies, ".", color=style_of[cell.variant].colour, markersize=2.2, antialiased=False)
        log_axis(axes, "y", f"{short(cell.variant, 18)}\nlatency, ms", *ends)
    every[-1].set_xlabel("seconds since the run began")
    return figure


def _bands(axes: Axes, found: Sequence[tuple[str, float]], end: float, *, named: bool) -> None:
    ends = [second for _, second in found[1:]] + [end]
    for number, ((name, begin), until) in enumerate(zip(found, ends, strict=False)):
        axes.axvspan(begin, max(begin, until), color=_BANDS[number % 2], zorder=0)
        axes.axvline(begin, color="#999", linewidth=0.6, zorder=1)
        if named:
            axes.annotate(
                name, ((begin + until) / 2, 1.02), xycoords=("data", "axes fraction"), fontsize=8, color="#333",
                ha="left", va="bottom", rotation=40, rotation_mode="anchor",
            )  # fmt: skip
    axes.set_xlim(-0.01 * end, 1.01 * end)
