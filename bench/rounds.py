"""Runs rounds of whole robots: a failed round is left out and noted, and the others still count."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console

from pebble.bench.results import Cell
from pebble.errors import PebbleError

_TIMEOUT_FACTOR = 2  # failures before the first success until the run is given up


class Rounds:
    """Counts successful and failed rounds of ``asked``."""

    def __init__(self, asked: int, console: Console) -> None:
        self._asked, self._console = asked, console
        self._done = 0
        self._failed: list[str] = []

    @contextmanager
    def attempt(self, number: int) -> Iterator[None]:
        """Runs round ``number``, from 0. Raises PebbleError if the first rounds fail, since all would."""
        try:
            yield
        except PebbleError as error:
            self._failed.append(f"round {number + 1}: {error}")
            if not self._done and len(self._failed) == min(_TIMEOUT_FACTOR, self._asked):
                raise
            self._console.print(self._failed[-1], style="red", highlight=False, markup=False)
        else:
            self._done += 1

    def notes(self) -> list[str]:
        """A sentence for the assessment: how many rounds failed, and why the first of them did."""
        if not self._failed:
            return []
        why = self._failed[0].splitlines()[0]
        return [f"{len(self._failed)} of {self._asked} rounds failed and were left out; {why}"]

    def code(self, cells: Sequence[Cell]) -> int:
        """The exit code: 1 if a cell has no samples, or too few of enough requested rounds are left."""
        from pebble.bench.ratios import LEAST_ROUNDS  # numpy: importing it earlier would change the robots' PSS

        return int(self._done < LEAST_ROUNDS <= self._asked or not all(cell.samples for cell in cells))
