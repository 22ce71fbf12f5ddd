"""The latest report of every media program, without those that stopped reporting. Pure: times are passed in."""

from __future__ import annotations

from typing import Final

from pebble.contract.payloads import MediaReport

SILENCE_S: Final = 5.0
_PROGRAM_LIMIT = 32


class Reports:
    """Reports by program."""

    def __init__(self) -> None:
        self._reports: dict[str, tuple[float, MediaReport]] = {}
        self.refused = 0  # reports of more programs than any robot has

    def put(self, program: str, report: MediaReport, now: float) -> None:
        if program not in self._reports and len(self.current(now)) >= _PROGRAM_LIMIT:
            self.refused += 1
            return
        self._reports[program] = (now, report)

    def current(self, now: float) -> dict[str, MediaReport]:
        """The reports of the last SILENCE_S seconds, by program name."""
        self._reports = {name: (at, report) for name, (at, report) in self._reports.items() if now - at < SILENCE_S}
        return {name: self._reports[name][1] for name in sorted(self._reports)}
