"""The operator page: its server as a process of its own, with a log."""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from typing import Any

import msgspec

from pebble.rig.programs import Program
from pebble.web.extra import require_packages
from pebble.web.program import Ready

_HOST = "127.0.0.1"
_START_S = 15.0  # it takes a while to import on a small machine


class PageServer(Program):
    """A server of the operator page for one broker. Raises PebbleError.

    ``port`` 0 is a free one. ``settings`` are further fields of WebSettings.
    """

    def __init__(self, folder: Path, broker_port: int, port: int = 0, **settings: Any) -> None:
        require_packages()
        self.url = ""
        fields = {"broker": {"host": _HOST, "port": broker_port}, "host": _HOST, "port": port, **settings}
        command = [sys.executable, "-m", "pebble.web.program", msgspec.json.encode(fields, enc_hook=str).decode()]
        super().__init__("the operator page", command, folder / "page.log", reports=True)
        self._answer: list[bytes] = []
        threading.Thread(target=self._read, name="address of the page", daemon=True).start()

    def wait(self, ending: threading.Event | None = None) -> None:
        """Wait until the page can be opened at ``url``, or ``ending``. Raises PebbleError if it cannot."""
        self.wait_until(lambda: bool(self._answer and self._answer[0]), _START_S, ending)
        if self._answer:
            self.url = msgspec.json.decode(self._answer[0], type=Ready).url

    def _read(self) -> None:
        self._answer.append(self.reports.readline())
