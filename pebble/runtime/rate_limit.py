"""A log with a limited rate of lines, for events that may happen a thousand times a second."""

import logging
import threading
import time


class RateLimitedLog:
    """A log of at most ``burst`` lines per ``period_s`` and subject, each with the number of events so far.

    Subjects are names from a fixed set. If they come from the wire, ``most`` must limit their number in a period: all
    further subjects then count as one.
    """

    def __init__(self, log: logging.Logger, *, burst: int = 1, period_s: float = 5.0, most: int | None = None) -> None:
        self._log, self._burst, self._period, self._most = log, burst, period_s, most
        self._lock = threading.Lock()
        self._totals: dict[str, int] = {}
        self._windows: dict[str, tuple[float, int]] = {}  # start of a period, and lines in it

    def warning(self, subject: str, text: str, *values: object, times: int = 1) -> None:
        """Count ``times`` events, and log one line if the limit allows."""
        total = self._count(subject, times)
        if total:
            self._log.warning(text + " (%d so far)", *values, total)

    def exception(self, subject: str, text: str, *values: object) -> None:
        """Like :meth:`warning`, as an error with the traceback of the exception that is being handled."""
        total = self._count(subject)
        if total:
            self._log.error(text + " (%d so far)", *values, total, exc_info=True)

    def log(self, subject: str, level: int, text: str, *values: object) -> None:
        """Like :meth:`warning`, at ``level`` and without the number."""
        if self._count(subject):
            self._log.log(level, text, *values)

    def totals(self) -> dict[str, int]:
        """Return the number of events of each subject, logged or not."""
        with self._lock:
            return dict(self._totals)

    def _count(self, subject: str, times: int = 1) -> int:
        """Count an event; return the number so far if it may be logged now, else 0."""
        now = time.monotonic()
        with self._lock:
            if self._most is not None and subject not in self._windows and len(self._windows) >= self._most:
                subject = self._make_room(subject, now)
            total = self._totals[subject] = self._totals.get(subject, 0) + times
            began, lines = self._windows.get(subject, (float("-inf"), 0))
            if now - began >= self._period:
                began, lines = now, 0
            if lines >= self._burst:
                return 0
            self._windows[subject] = (began, lines + 1)
            return total

    def _make_room(self, subject: str, now: float) -> str:
        """Forget subjects whose period is over; return the subject to count under, "" if there is no room."""
        expired = [name for name, (began, _) in self._windows.items() if name and now - began >= self._period]
        for name in expired:
            del self._windows[name], self._totals[name]
        return subject if len(self._windows) < (self._most or 0) else ""
