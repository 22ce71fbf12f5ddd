"""Collects what media programs report of themselves, and forgets those that fell silent. Clock values are passed in."""

from __future__ import annotations

from typing import Final

from pebble.payloads import MediaReport

SILENCE_S: Final = 5.0
_PROGRAM_LIMIT = 32


class Board:
    """The latest report of every program."""

    def __init__(self) -> None:
        self._reports: dict[str, tuple[float, MediaReport]] = {}
        self.refused = 0  # reports of more programs than any robot has

    def hear(self, program: str, report: MediaReport, now: float) -> None:
        if program not in self._reports and len(self.heard(now)) >= _PROGRAM_LIMIT:
            self.refused += 1
            return
        self._reports[program] = (now, report)

    def heard(self, now: float) -> dict[str, MediaReport]:
        """Of those that are not silent, by name."""
        self._reports = {name: (at, report) for name, (at, report) in self._reports.items() if now - at < SILENCE_S}
        return {name: self._reports[name][1] for name in sorted(self._reports)}
