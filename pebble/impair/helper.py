"""The process that carries a link: asked in lines, it answers in JSON, and it ends when whoever asks does."""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path
from typing import Any

from pebble.bench.frames_process import Worker, end_workers
from pebble.errors import PebbleError

_ANSWER_S = 10.0


class UnavailableError(PebbleError):
    """There can be no such link on this machine, or for this user."""


class Helper:
    """Starts ``python -m module``, waits for its first answer (`hello`), and asks it from any thread."""

    def __init__(self, name: str, module: str) -> None:
        self._log = os.memfd_create("link")  # its log is a file without a name: nothing stays if we are killed
        self._lock = threading.Lock()
        self._worker = Worker(name, [sys.executable, "-m", module], Path(f"/proc/self/fd/{self._log}"))
        self._open = True
        try:
            self.hello = self._greeting()
        except BaseException:
            self.close()
            raise

    @property
    def pid(self) -> int:
        return self._worker.pid

    def ask(self, line: str) -> dict[str, Any]:
        """Raises PebbleError if it ends or is silent: then it is closed, or its late answer would be the next one's."""
        with self._lock:
            if not self._open:
                raise PebbleError(f"{self._worker.name} is closed")
            try:
                self._worker.tell(line)
                return self._worker.answer(_ANSWER_S)
            except BrokenPipeError:
                raise PebbleError(f"{self._worker.name} has ended") from None
            except PebbleError:
                self._close()
                raise

    def close(self) -> None:
        with self._lock:
            self._close()

    def _close(self) -> None:
        if self._open:
            self._open = False
            end_workers([self._worker])
            os.close(self._log)

    def _greeting(self) -> dict[str, Any]:
        """Raises PebbleError for ``{"error": …}``, UnavailableError for ``{"unavailable": …}``."""
        said = self._worker.answer(_ANSWER_S)
        if "unavailable" in said:
            raise UnavailableError(str(said["unavailable"]))
        if "error" in said:
            raise PebbleError(str(said["error"]))
        return said
