"""Child processes that surely end: each with its own log file, deadline, and a tie to the life of this process."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import IO

from pebble.errors import PebbleError
from pebble.launched import tied

_STEP_S = 0.01


class Program:
    """One started program. It leads a session of its own: a Ctrl-C in the terminal is ours to act on, in order.

    Start programs from the main thread: the kernel ties their life to the thread that started them.
    """

    def __init__(self, name: str, command: Sequence[str], log: Path, *, reports: bool = False) -> None:
        self.name, self.log = name, log
        with log.open("ab") as errors:
            self._process = subprocess.Popen(
                tied(command, signal.SIGTERM),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE if reports else errors,
                stderr=errors,
                start_new_session=True,
            )

    @property
    def reports(self) -> IO[bytes]:
        """What the program writes to its standard output, if it was started with ``reports``."""
        if self._process.stdout is None:
            raise PebbleError(f"{self.name} was not started to report")
        return self._process.stdout

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def ended(self) -> bool:
        return self._process.poll() is not None

    def wait_until(self, condition: Callable[[], bool], timeout: float, ending: threading.Event) -> None:
        """Wait for a sign of life, or until ``ending``.

        Raises PebbleError if it does not come or the program ends first.
        """
        end = time.monotonic() + timeout
        while not condition() and not ending.wait(_STEP_S):
            if self.ended:
                raise PebbleError(f"{self.name} ended at once with code {self._process.returncode}: see {self.log}")
            if time.monotonic() > end:
                raise PebbleError(f"{self.name} was not ready after {timeout:.0f} s: see {self.log}")

    def ask_to_end(self) -> None:
        if not self.ended:
            self._process.terminate()

    def end(self, deadline: float) -> None:
        """Wait until ``deadline`` (monotonic), then end it and what it started the hard way."""
        try:
            self._process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()


def end_all(programs: Iterable[Program], within_s: float) -> None:
    """End these at the same time."""
    programs = list(programs)
    deadline = time.monotonic() + within_s
    for program in programs:
        program.ask_to_end()
    for program in programs:
        program.end(deadline)
