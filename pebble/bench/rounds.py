"""Rounds of whole robots: one that fails is left out and told, and the others count all the same."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console

from pebble.bench.results import Cell
from pebble.errors import PebbleError

_PATIENCE = 2  # failures before the first success: there is no use in going on


class Rounds:
    """So many were asked for."""

    def __init__(self, asked: int, console: Console) -> None:
        self._asked, self._console = asked, console
        self._done = 0
        self._failed: list[str] = []

    @contextmanager
    def attempt(self, number: int) -> Iterator[None]:
        """Round ``number``, from 0. Raises PebbleError where the first ones fail, as all would."""
        try:
            yield
        except PebbleError as error:
            self._failed.append(f"round {number + 1}: {error}")
            if not self._done and len(self._failed) == min(_PATIENCE, self._asked):
                raise
            self._console.print(self._failed[-1], style="red", highlight=False, markup=False)
        else:
            self._done += 1

    def told(self) -> list[str]:
        """For the verdict: how many were left out, and why the first of them was."""
        if not self._failed:
            return []
        why = self._failed[0].splitlines()[0]
        return [f"{len(self._failed)} of {self._asked} rounds failed and were left out; {why}"]

    def code(self, cells: Sequence[Cell]) -> int:
        """Of the command: 1 if something has no figures, or too few rounds are left although enough were asked for."""
        from pebble.bench.ratios import LEAST_ROUNDS  # numpy: not while robots are measured that map it too

        return int(self._done < LEAST_ROUNDS <= self._asked or not all(cell.samples for cell in cells))
