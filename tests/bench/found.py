"""Cells of results, by what was measured."""

from pebble.bench.results import Cell, Results, Value


def found(results: Results, variant: str, measure: str | None = None, **params: Value) -> Cell | None:
    same = (one for one in results.cells if one.variant == variant and params.items() <= one.params.items())
    return next((one for one in same if measure in (None, one.measure)), None)
