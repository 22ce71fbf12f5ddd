"""A worker process of a comparison: reads lines from standard input, answers in JSON lines, and ends with its input."""

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
    """Runs the process. It ends when its standard input closes, and so also when this process ends in any way."""

    def __init__(self, name: str, command: Sequence[str], log: Path) -> None:
        self.name, self._log = name, log
        self._answers: queue.Queue[dict[str, Any] | None] = queue.Queue()
        with log.open("ab") as errors:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                start_new_session=True,  # only the starting process handles Ctrl-C
            )
        threading.Thread(target=self._listen, name=f"answers of {name}", daemon=True).start()

    @property
    def pid(self) -> int:
        return self._process.pid

    def answer(self, timeout: float) -> dict[str, Any]:
        """The next answer. Raises PebbleError if the process ends, or does not answer within ``timeout`` seconds."""
        try:
            answer = self._answers.get(timeout=timeout)
        except queue.Empty:
            raise PebbleError(f"{self.name} did not answer within {timeout:.0f} s{self._tail()}") from None
        if answer is None:
            raise PebbleError(f"{self.name} ended with code {self._process.wait()}{self._tail()}")
        return answer

    def send(self, line: str) -> None:
        """Writes a line to standard input. Ignored if the process has ended: :meth:`answer` reports that."""
        if self._process.stdin is not None:
            with contextlib.suppress(BrokenPipeError):
                self._process.stdin.write(line.encode() + b"\n")
                self._process.stdin.flush()

    def close_input(self) -> None:
        if self._process.stdin is not None and not self._process.stdin.closed:
            with contextlib.suppress(BrokenPipeError):  # it ended by itself
                self._process.stdin.close()

    def end(self, deadline: float) -> None:
        """Waits until ``deadline`` (monotonic), then kills the process."""
        try:
            self._process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _listen(self) -> None:
        stdout = self._process.stdout
        if stdout is not None:
            for line in stdout:
                self._answers.put(json.loads(line))
        self._answers.put(None)

    def _tail(self) -> str:
        text = self._log.read_text(errors="replace").strip()
        return f":\n{text[-_TAIL:]}" if text else ""


def end_workers(workers: Iterable[Worker]) -> None:
    """Ends all workers at the same time; kills those that do not end within seconds."""
    workers = list(workers)
    deadline = time.monotonic() + _END_S
    for worker in workers:
        worker.close_input()
    for worker in workers:
        worker.end(deadline)
