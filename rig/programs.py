"""Child processes, each with a log file and a deadline to end; the kernel ends them when this process dies."""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar

from pebble.errors import PebbleError
from pebble.runtime.parent import tied_to_parent

Wrap = Callable[[Sequence[str]], Sequence[str]]  # extends a command, so that it runs in another network
Each = Callable[[bytes], object]  # gets one line of a program's standard output
_STEP_S = 0.01
_END_S = 4.0  # for workers
_TAIL = 2000  # characters of a log that are shown


def unchanged(command: Sequence[str]) -> Sequence[str]:
    return command


class Program:
    """One child process in its own session: Ctrl-C in a terminal reaches only this process, which ends them in order.

    Start programs from the main thread: the kernel ends them when the thread that started them ends.
    """

    has_input: ClassVar = False  # it ends with its standard input, not with the thread that starts it

    def __init__(self, name: str, command: Sequence[str], log: Path, each: Each | None = None) -> None:
        """``each`` runs on a thread of its own; without it standard output is in the log, as errors are."""
        self.name, self.log = name, log
        with log.open("ab") as errors:
            self._process = subprocess.Popen(
                command if self.has_input else tied_to_parent(command, signal.SIGTERM),
                stdin=subprocess.PIPE if self.has_input else subprocess.DEVNULL,
                stdout=errors if each is None else subprocess.PIPE,
                stderr=errors,
                start_new_session=True,
            )
        self.pid = self._process.pid
        self._reader = threading.Thread(target=self._read, args=(each,), name=f"output of {name}", daemon=True)
        if each is not None:
            self._reader.start()

    @property
    def is_read(self) -> bool:
        """Whether ``each`` still gets lines: the program has not closed its output, and no line was an error."""
        return self._reader.is_alive()

    @property
    def code(self) -> int | None:
        """Its exit code, once it has ended."""
        return self._process.poll()

    @property
    def ended(self) -> bool:
        return self.code is not None

    def tail(self) -> str:
        """The end of its log."""
        return self.log.read_text(errors="replace").strip()[-_TAIL:]

    def freeze(self) -> None:
        """SIGSTOP: its connections stay, and it answers nothing. A process that has ended stays so."""
        self._process.send_signal(signal.SIGSTOP)

    def thaw(self) -> None:
        self._process.send_signal(signal.SIGCONT)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()

    def wait_until(self, condition: Callable[[], bool], timeout: float, ending: threading.Event | None = None) -> None:
        """Wait for ``condition``, or until ``ending``. Raises PebbleError on timeout or if the program ends first."""
        end, ending = time.monotonic() + timeout, ending or threading.Event()
        while not condition() and not ending.wait(_STEP_S):
            if self.ended:
                raise PebbleError(f"{self.name} ended at once with code {self.code}: see {self.log}")
            if time.monotonic() > end:
                raise PebbleError(f"{self.name} was not ready after {timeout:.0f} s: see {self.log}")

    def ask_to_end(self) -> None:
        if not self.ended:
            self._process.terminate()

    def _read(self, each: Each) -> None:
        for line in self._process.stdout or ():
            each(line)


class Worker(Program):
    """A program that reads lines, answers in JSON lines, and ends with its input, so also when this process ends.

    Its other end is worker_end.
    """

    has_input = True

    def __init__(self, name: str, command: Sequence[str], log: Path) -> None:
        self._answers: queue.Queue[dict[str, Any] | None] = queue.Queue()
        super().__init__(name, command, log, each=lambda line: self._answers.put(json.loads(line)))

    def answer(self, timeout: float) -> dict[str, Any]:
        """The next answer. Raises PebbleError with its log if it ends, or does not answer within ``timeout`` s."""
        why = f"did not answer within {timeout:.0f} s"
        with suppress(queue.Empty):
            if (answer := self._answers.get(timeout=timeout)) is not None:
                return answer
            why = f"ended with code {self._process.wait()}"
        raise PebbleError(f"{self.name} {why}\n{self.tail()}".rstrip())

    def send(self, line: str) -> None:
        """Writes a line to standard input. Ignored if the process has ended: :meth:`answer` reports that."""
        if self._process.stdin is not None:
            with suppress(BrokenPipeError):
                self._process.stdin.write(line.encode() + b"\n")
                self._process.stdin.flush()

    def ask(self, line: str, timeout: float) -> dict[str, Any]:
        self.send(line)
        return self.answer(timeout)

    def ask_to_end(self) -> None:
        if self._process.stdin is not None:
            with suppress(BrokenPipeError):  # it ended by itself
                self._process.stdin.close()

    def _read(self, each: Each) -> None:
        super()._read(each)
        self._answers.put(None)


def end_all(programs: Iterable[Program], within_s: float) -> None:
    """Send SIGTERM to all (to workers: the end of input); kill those that still run after it, with their children."""
    programs, deadline = list(programs), time.monotonic() + within_s
    for program in programs:
        program.ask_to_end()
    for program in programs:
        try:
            program._process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            os.killpg(program.pid, signal.SIGKILL)
            program._process.wait()


def end_workers(workers: Iterable[Worker]) -> None:
    end_all(workers, _END_S)


def children(pid: int) -> list[int]:
    """The direct children of a process; none if it has ended. Not every kernel has /proc/PID/task/TID/children."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(FileNotFoundError, ProcessLookupError):  # it has ended meanwhile
            if int((process / "stat").read_text().rpartition(")")[2].split()[1]) == pid:
                found.append(int(process.name))
    return sorted(found)
