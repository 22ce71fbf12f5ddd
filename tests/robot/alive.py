"""Which scripts are alive, by the environment of processes; and whether two ever were at the same time."""

from __future__ import annotations

import os
import threading
import time
from contextlib import suppress
from pathlib import Path

from tests.support import gone

_PERIOD_S = 0.01
_YOUNG_S = 1.0  # the environment of a process is its own only after exec


class Alive:
    """Looks every 10 ms for processes that have a config in ``folder`` in their environment, as scripts have."""

    def __init__(self, folder: Path) -> None:
        self._mark = b"PEBBLE_CONFIG=" + str(folder).encode()
        self._seen: dict[int, float] = {}  # processes that are no scripts, by when they were first seen
        self.overlaps: list[tuple[float, list[int]]] = []
        self.groups: set[int] = set()  # of scripts, at the last look
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(_PERIOD_S):
            self.look()

    def look(self) -> None:
        now = time.monotonic()
        with os.scandir("/proc") as entries:
            pids = {int(entry.name) for entry in entries if entry.name.isdigit()}
        self._seen = {pid: at for pid, at in self._seen.items() if pid in pids}
        groups: dict[int, int] = {}
        for pid in pids:
            if now - self._seen.get(pid, now) < _YOUNG_S and self._is_script(pid):
                self._seen.pop(pid, None)
                with suppress(ProcessLookupError):
                    groups[os.getpgid(pid)] = pid
            else:
                self._seen.setdefault(pid, now)
        if len(groups) > 1 and sum(not gone(pid) for pid in groups.values()) > 1:
            self.overlaps.append((now, sorted(groups.values())))
        self.groups = set(groups)

    def _is_script(self, pid: int) -> bool:
        try:
            return self._mark in Path(f"/proc/{pid}/environ").read_bytes() and not gone(pid)
        except OSError:
            return False
