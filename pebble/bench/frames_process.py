"""A process that measures for a comparison: it answers in JSON lines, obeys its standard input, and ends with it."""

from __future__ import annotations

import contextlib
import json
import queue
import subprocess
import threading
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from pebble.errors import PebbleError

_END_S = 4.0
_TAIL = 600  # characters of a log that are shown


class Worker:
    """Its standard input is its leash: when this process ends, in whatever way, it reads the end and goes."""

    def __init__(self, name: str, command: Sequence[str], log: Path) -> None:
        self.name, self._log = name, log
        self._said: queue.Queue[dict[str, Any] | None] = queue.Queue()
        with log.open("ab") as errors:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                start_new_session=True,  # a Ctrl-C in the terminal is for whoever started us
            )
        threading.Thread(target=self._listen, name=f"answers of {name}", daemon=True).start()

    @property
    def pid(self) -> int:
        return self._process.pid

    def answer(self, timeout: float) -> dict[str, Any]:
        """What it says next. Raises PebbleError if it ends, or says nothing for ``timeout`` seconds."""
        try:
            said = self._said.get(timeout=timeout)
        except queue.Empty:
            raise PebbleError(f"{self.name} said nothing for {timeout:.0f} s{self._tail()}") from None
        if said is None:
            raise PebbleError(f"{self.name} ended with code {self._process.wait()}{self._tail()}")
        return said

    def tell(self, line: str) -> None:
        """Nothing happens if it has ended: :meth:`answer` says so."""
        if self._process.stdin is not None:
            with contextlib.suppress(BrokenPipeError):
                self._process.stdin.write(line.encode() + b"\n")
                self._process.stdin.flush()

    def ask_to_end(self) -> None:
        if self._process.stdin is not None and not self._process.stdin.closed:
            with contextlib.suppress(BrokenPipeError):  # it went by itself
                self._process.stdin.close()

    def end(self, deadline: float) -> None:
        """Wait until ``deadline`` (monotonic), then the hard way."""
        try:
            self._process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _listen(self) -> None:
        stdout = self._process.stdout
        if stdout is not None:
            for line in stdout:
                self._said.put(json.loads(line))
        self._said.put(None)

    def _tail(self) -> str:
        text = self._log.read_text(errors="replace").strip()
        return f":\n{text[-_TAIL:]}" if text else ""


def end_workers(workers: Iterable[Worker]) -> None:
    """All at the same time; one that does not go within seconds is killed."""
    workers = list(workers)
    deadline = time.monotonic() + _END_S
    for worker in workers:
        worker.ask_to_end()
    for worker in workers:
        worker.end(deadline)
