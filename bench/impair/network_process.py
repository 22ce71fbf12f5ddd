"""The process behind an impaired network: it reads requests as lines, answers in JSON, and ends with its input."""

from __future__ import annotations

import os
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pebble.errors import PebbleError
from pebble.rig.worker import Worker, end_workers

_ANSWER_S = 10.0


@dataclass(frozen=True)
class Traffic:
    """Counters since the network was opened, with all headers, including dropped packets.

    Packets dropped by the rate limit were never on the wire; lost packets were.
    """

    bytes_up: int = 0
    bytes_down: int = 0
    packets_up: int = 0
    packets_down: int = 0
    dropped_up: int = 0
    dropped_down: int = 0


class UnavailableError(PebbleError):
    """This machine or user does not permit such a network."""


class NetworkProcess:
    """Starts ``python -m module`` and waits for its first answer (`greeting`); thread-safe."""

    def __init__(self, name: str, module: str) -> None:
        self._log = os.memfd_create("link")  # the log is an unnamed file: nothing is left behind if we are killed
        self._lock = threading.Lock()
        self._worker = Worker(name, [sys.executable, "-m", module], Path(f"/proc/self/fd/{self._log}"))
        self._open = True
        try:
            self.greeting = self._greeting()
        except BaseException:
            self.close()
            raise

    @property
    def pid(self) -> int:
        return self._worker.pid

    def ask(self, line: str) -> dict[str, Any]:
        """Sends a line and returns the answer. A timeout closes the process: its late answer would be misread."""
        with self._lock:
            if not self._open:
                raise PebbleError(f"{self._worker.name} is closed")
            try:
                return self._worker.ask(line, _ANSWER_S)
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
        """The first answer. Raises PebbleError for ``{"error": …}``, UnavailableError for ``{"unavailable": …}``."""
        answer = self._worker.answer(_ANSWER_S)
        if "unavailable" in answer:
            raise UnavailableError(str(answer["unavailable"]))
        if "error" in answer:
            raise PebbleError(str(answer["error"]))
        return answer
