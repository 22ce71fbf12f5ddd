"""What the robot's processes cannot provide at present, whatever its config says: capabilities leave it out. Pure."""

from __future__ import annotations

import re
from collections.abc import Callable

_report = re.compile(r"(LACKS|HAS) (estop)", re.ASCII).fullmatch


class Lacking:
    """Handles ``LACKS <feature>`` and ``HAS <feature>``; ``on_change()`` is called when :attr:`features` changes."""

    def __init__(self, on_change: Callable[[], None]) -> None:
        self._on_change = on_change
        self._reports: set[tuple[str, str]] = set()  # program, feature

    @property
    def features(self) -> frozenset[str]:
        """What at least one process lacks."""
        return frozenset(feature for _, feature in self._reports)

    def receive(self, program: str, line: str) -> bool:
        """Handle a note of ``program``; False if it is none of these."""
        found = _report(line)
        if found is None:
            return False
        report = {(program, found[2])}
        self._set(self._reports | report if found[1] == "LACKS" else self._reports - report)
        return True

    def ended(self, program: str) -> None:
        """Forget what a process reported that has ended."""
        self._set({report for report in self._reports if report[0] != program})

    def _set(self, reports: set[tuple[str, str]]) -> None:
        before, self._reports = self.features, reports
        if self.features != before:
            self._on_change()
