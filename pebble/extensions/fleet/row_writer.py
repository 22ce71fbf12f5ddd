"""Writes audit rows on another thread, so that no caller waits for the disk."""

import logging
import threading
import time
from collections.abc import Callable, Hashable
from typing import Any

from pebble.errors import PebbleError

log = logging.getLogger(__name__)

WINDOW_S = 60.0  # of similar rows within it two are stored: the first, and the newest with the number of copies
#: Different rows within it; those beyond are counted by their kind. What comes in any number and matters little (what
#: strangers are refused, and lights and sounds of anybody) may not fill it: stops and control have the rest.
DIFFERENT, OF_STRANGERS = 300, 100
WAITING = 1000  # rows that are not stored yet
_ROUND_S = 10.0  # between two looks at what was counted, and two tries at a disk that takes nothing
_END_S = 3.0  # longest wait for the last rows

Row = dict[str, Any]


class RowWriter:
    """A queue of rows for ``store``, which gets them in order. Thread-safe.

    If ``store`` raises OSError or PebbleError, the rows wait, and that is logged once. A row has its time ``t``, its
    kind ``what`` from a fixed set, and more fields.
    """

    def __init__(self, store: Callable[[list[Row]], None], clock: Callable[[], float] = time.monotonic) -> None:
        self._store, self._clock = store, clock
        self._lock = threading.Lock()  # guards what follows
        #: By a key that similar rows share: the newest one in this window, and how many were not stored.
        self._counts: dict[Hashable, tuple[Row, int]] = {}
        self._since = 0.0  # when the window began
        self._rows: list[Row] = []  # that wait
        self._lost = 0  # rows for which there was no room
        self._saved = True  # did ``store`` take the rows when it was called last?
        self._wake, self._closing = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="audit", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """Store the waiting rows, for a limited time."""
        self._closing.set()
        self._wake.set()
        self._thread.join(_END_S)
        if lost := sum(row.get("count", 1) for row in self._rows) + self._lost:
            log.error("audit: %d rows are lost", lost)

    def add(self, row: Row, like: Hashable = None, most: int = DIFFERENT) -> None:
        """Store ``row``; if a similar row was stored in this window of WINDOW_S, only count it.

        ``like``: a key that similar rows share; None: all fields but the time. Once the window has ``most`` keys, rows
        with further ones are stored as their kind alone, so that they are similar to each other.
        """
        key = tuple(row.items())[1:] if like is None else like  # the row without its time, the first item
        now = self._clock()
        with self._lock:
            if now - self._since >= WINDOW_S:
                self._end_window(now)
            if key not in self._counts and len(self._counts) >= most:
                row, key = {"t": row["t"], "what": row["what"]}, row["what"]
            copies = self._counts[key][1] + 1 if key in self._counts else 0
            self._counts[key] = row, copies
            if not copies:
                self._put(row)
        self._wake.set()

    def _end_window(self, now: float) -> None:
        """Begin a new window. Where similar rows were only counted, queue the newest of them, with their number."""
        for row, count in self._counts.values():
            if count:
                self._put({**row, "count": count})
        self._counts, self._since = {}, now

    def _put(self, row: Row) -> None:
        if len(self._rows) < WAITING:
            self._rows.append(row)
        else:
            self._lost += row.get("count", 1)

    def _run(self) -> None:
        ends = False
        while not ends:
            self._wake.wait(_ROUND_S)
            self._wake.clear()
            ends = self._closing.is_set()
            with self._lock:
                if ends or self._clock() - self._since >= WINDOW_S:
                    self._end_window(self._clock())
            self._store_all()

    def _store_all(self) -> None:
        """Store the waiting rows, and how many are lost; if that fails, they go on waiting."""
        with self._lock:
            waiting, lost = len(self._rows), self._lost
            rows = [*self._rows]
        if lost:
            rows.append({"t": round(time.time(), 3), "what": "audit-dropped", "count": lost})
        if not rows:
            return
        try:
            self._store(rows)
        except (OSError, PebbleError) as error:
            if self._saved:
                log.error("audit: rows wait to be written: %s", error)
            self._saved = False
            return
        if not self._saved:
            log.warning("audit: rows are written again, %d are lost", lost)
        self._saved = True
        with self._lock:
            del self._rows[:waiting]
            self._lost -= lost
