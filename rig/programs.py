"""Child processes, each with a log file and a deadline to end; the kernel ends them when this process dies."""

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
from pebble.runtime.parent import tied_to_parent

_STEP_S = 0.01


class Program:
    """One child process in its own session: Ctrl-C in a terminal reaches only this process, which ends them in order.

    Start programs from the main thread: the kernel ends them when the thread that started them ends.
    """

    def __init__(self, name: str, command: Sequence[str], log: Path, *, reports: bool = False) -> None:
        self.name, self.log = name, log
        with log.open("ab") as errors:
            self._process = subprocess.Popen(
                tied_to_parent(command, signal.SIGTERM),
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
        """Wait for ``condition``, or until ``ending``. Raises PebbleError on timeout or if the program ends first."""
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
        """Wait until ``deadline`` (monotonic), then kill the program and its children."""
        try:
            self._process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()


def end_all(programs: Iterable[Program], within_s: float) -> None:
    """Send SIGTERM to all of them, and kill those that still run after ``within_s``."""
    programs = list(programs)
    deadline = time.monotonic() + within_s
    for program in programs:
        program.ask_to_end()
    for program in programs:
        program.end(deadline)
