"""Collects the measurements of one robot under one load, and turns them into cells. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from pebble.bench.bridge_drive import Arrived, DriveSegment
from pebble.bench.results import Cell, Value, rounded

UNLOADED, LOADED = "none", "media"
DOWN, UP = "down", "up"


class Tally:
    """With ``reports`` there is a cell for the MCU's reports, too."""

    def __init__(self, variant: str, load: str = UNLOADED, *, reports: bool = True) -> None:
        self.variant, self.load, self._reports = variant, load, reports
        self._rounds: list[list[Arrived]] = []
        self._cpu_s = self._took_s = 0.0
        self._flowed: dict[str, int] = {}

    def add_round(
        self, segments: Sequence[DriveSegment], found: Sequence[Arrived], flowed: Mapping[str, int] | None = None
    ) -> None:
        """``flowed`` counts the media received meanwhile."""
        self._rounds.append(list(found))
        self._cpu_s += sum(segment.cpu_s for segment in segments)
        self._took_s += sum(segment.ended - segment.began for segment in segments) / 1e9
        for name, count in (flowed or {}).items():
            self._flowed[name] = self._flowed.get(name, 0) + count

    def cells(self) -> list[Cell]:
        sent = sum(one.sent for one in self._found())
        down = self._cell(DOWN, sent, [[ms for one in found for ms in one.down] for found in self._rounds])
        if not self._reports:
            return [down]
        published = sum(one.reports for one in self._found())
        return [down, self._cell(UP, published, [[ms for one in found for ms in one.up] for found in self._rounds])]

    def _found(self) -> Iterable[Arrived]:
        return (one for found in self._rounds for one in found)

    def _cell(self, measure: str, sent: int, rounds: list[list[float]]) -> Cell:
        figures: dict[str, Value] = {"sent": sent}
        if self._cpu_s:
            figures["cpu_percent"] = rounded(100 * self._cpu_s / self._took_s, 1)
        figures |= {f"{name}_per_s": round(count / self._took_s, 1) for name, count in self._flowed.items()}
        params: dict[str, Value] = {"load": self.load}
        return Cell(variant=self.variant, params=params, measure=measure, unit="ms", rounds=rounds, figures=figures)
