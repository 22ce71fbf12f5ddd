"""The kinds of pictures that a comparison may declare; matplotlib is imported only when one is drawn."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

from pebble.bench.results import Results

if TYPE_CHECKING:
    from pebble.bench.plots import Picture


@dataclass(frozen=True, slots=True)
class Drawn:
    """A function that makes pictures of results: ``module:function``, and its further arguments."""

    by: str
    arguments: tuple[Any, ...] = ()

    def pictures(self, results: Results) -> list[Picture]:
        module, _, name = self.by.partition(":")
        found: list[Picture] = getattr(import_module(module), name)(results, *self.arguments)
        return found


def ecdf(title: str, *, measures: tuple[str, ...] = ()) -> Drawn:
    """For each measure the share of messages within a time; one panel for each condition."""
    return Drawn("pebble.bench.charts:distributions", (title, measures))


def ratios(title: str, baseline: str, *, measures: tuple[str, ...] = ()) -> Drawn:
    """The medians as ratios to the baseline's, with their intervals."""
    return Drawn("pebble.bench.charts:ratios", (title, baseline, measures))


def null_ratios(title: str) -> Drawn:
    """The ratios of a null test to the plain role."""
    return Drawn("pebble.bench.charts:null_ratios", (title,))


def dots(title: str) -> Drawn:
    """A dot for each sample, and a line at the median; one panel for each measure."""
    return Drawn("pebble.bench.charts:dots", (title,))


def bars(title: str, *, measures: tuple[str, ...] = (), panel: str = "", group: str = "") -> Drawn:
    """A bar for each median: one picture for each measure, with a panel or a group for each value of a parameter."""
    return Drawn("pebble.bench.charts:bars", (title, measures, panel, group))


def tails(title: str) -> Drawn:
    """Bars to the medians, lines to the 99th percentiles; one panel for each condition."""
    return Drawn("pebble.bench.charts:tails", (title,))
