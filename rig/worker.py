"""Worker processes: each reads lines from its standard input, answers in JSON lines, and ends with its input."""

from __future__ import annotations

import contextlib
import json
import queue
import subprocess
import threading
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from pebble.errors import PebbleError
from pebble.rig.programs import Program, end_all

_END_S = 4.0


class Worker(Program):
    """Runs the process. It ends when its standard input closes, and so also when this process ends in any way."""

    def __init__(self, name: str, command: Sequence[str], log: Path) -> None:
        self._answers: queue.Queue[dict[str, Any] | None] = queue.Queue()
        super().__init__(name, command, log, stdin=subprocess.PIPE, reports=True, tied=False)
        threading.Thread(target=self._listen, name=f"answers of {name}", daemon=True).start()

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

    def ask(self, line: str, timeout: float) -> dict[str, Any]:
        self.send(line)
        return self.answer(timeout)

    def ask_to_end(self) -> None:
        if self._process.stdin is not None and not self._process.stdin.closed:
            with contextlib.suppress(BrokenPipeError):  # it ended by itself
                self._process.stdin.close()

    def _listen(self) -> None:
        for line in self.reports:
            self._answers.put(json.loads(line))
        self._answers.put(None)

    def _tail(self) -> str:
        text = self.tail()
        return f":\n{text}" if text else ""


def end_workers(workers: Iterable[Worker]) -> None:
    """Ends all workers at the same time; kills those that do not end within seconds."""
    end_all(workers, _END_S)
