"""Log lines about something that may happen a thousand times a second."""

from __future__ import annotations

import logging
import threading
import time


class RateLimitedLog:
    """At most ``burst`` lines per ``period_s`` and subject, each telling how often it has happened by then.

    A subject is a name from a fixed set, never text from the wire.
    """

    def __init__(self, log: logging.Logger, *, burst: int = 1, period_s: float = 5.0) -> None:
        self._log, self._burst, self._period = log, burst, period_s
        self._lock = threading.Lock()
        self._totals: dict[str, int] = {}
        self._windows: dict[str, tuple[float, int]] = {}  # when it began, lines said in it

    def warning(self, subject: str, text: str, *values: object, times: int = 1) -> None:
        """Say that it happened, ``times`` times since the last call."""
        total = self._count(subject, times)
        if total:
            self._log.warning(text + " (%d so far)", *values, total)

    def say(self, subject: str, level: int, text: str, *values: object) -> None:
        """Like :meth:`warning`, at ``level`` and without the number."""
        if self._count(subject):
            self._log.log(level, text, *values)

    def totals(self) -> dict[str, int]:
        """How often each subject came up, said or not."""
        with self._lock:
            return dict(self._totals)

    def _count(self, subject: str, times: int = 1) -> int:
        """How often ``subject`` has come up if it may be said now, else 0."""
        now = time.monotonic()
        with self._lock:
            total = self._totals[subject] = self._totals.get(subject, 0) + times
            began, said = self._windows.get(subject, (float("-inf"), 0))
            if now - began >= self._period:
                began, said = now, 0
            if said >= self._burst:
                return 0
            self._windows[subject] = (began, said + 1)
            return total
