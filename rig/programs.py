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

Wrap = Callable[[Sequence[str]], Sequence[str]]
"""Extends a command, so that it runs in another network."""

_STEP_S = 0.01
_TAIL = 2000  # characters of a log that are shown
_PROC = Path("/proc")


def unchanged(command: Sequence[str]) -> Sequence[str]:
    return command


class Program:
    """One child process in its own session: Ctrl-C in a terminal reaches only this process, which ends them in order.

    Start programs from the main thread: the kernel ends them when the thread that started them ends.
    """

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        log: Path,
        *,
        stdin: int = subprocess.DEVNULL,
        reports: bool = False,
        tied: bool = True,
    ) -> None:
        """``tied``: the kernel ends it when the thread that starts it ends."""
        self.name, self.log = name, log
        with log.open("ab") as errors:
            self._process = subprocess.Popen(
                tied_to_parent(command, signal.SIGTERM) if tied else command,
                stdin=stdin,
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
    def code(self) -> int | None:
        """Its exit code, once it has ended."""
        return self._process.poll()

    @property
    def ended(self) -> bool:
        return self.code is not None

    def tail(self) -> str:
        """The end of its log."""
        return self.log.read_text(errors="replace").strip()[-_TAIL:] if self.log.exists() else ""

    def kill(self) -> None:
        """SIGKILL; returns when it has ended."""
        self._process.kill()
        self._process.wait()

    def freeze(self) -> None:
        """SIGSTOP: its connections stay, and it answers nothing. A process that has ended stays so."""
        self._process.send_signal(signal.SIGSTOP)

    def thaw(self) -> None:
        self._process.send_signal(signal.SIGCONT)

    def wait_until(self, condition: Callable[[], bool], timeout: float, ending: threading.Event | None = None) -> None:
        """Wait for ``condition``, or until ``ending``. Raises PebbleError on timeout or if the program ends first."""
        end, ending = time.monotonic() + timeout, ending or threading.Event()
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


def children(pid: int) -> list[int]:
    """The direct children of a process; none if it has ended.

    Reads the parent of every process: not every kernel has ``/proc/<pid>/task/<tid>/children``.
    """
    return sorted(int(one.name) for one in _PROC.iterdir() if one.name.isdecimal() and _parent(one) == pid)


def _parent(process: Path) -> int | None:
    try:
        return int((process / "stat").read_text().rpartition(")")[2].split()[1])
    except (FileNotFoundError, ProcessLookupError):  # it has ended meanwhile
        return None
