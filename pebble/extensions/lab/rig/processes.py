"""Child processes, each with a log file and a time limit for its end; the kernel ends them when this process dies."""

import json
import os
import queue
import random
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

from pebble.errors import PebbleError
from pebble.extensions.media.child import tied_to_parent
from pebble.extensions.operator.places import mosquitto_path

#: Kinds of processes, in the order in which they end: robots say so to brokers, which end later, as MCUs do.
OPERATORS, ROBOTS, MCUS, BROKERS = range(4)

HOST = "127.0.0.1"  # of brokers
_PORTS = 10_100, 32_768  # below those of outgoing connections, on Linux and elsewhere; no browser opens 10080
_LONGEST_FOLDER = 40  # characters: Unix sockets live below, and their paths end at 108 bytes

Wrap = Callable[[Sequence[str]], Sequence[str]]  # extends a command, so that it runs in another network
OnLine = Callable[[bytes], object]  # gets each line of a program's standard output
_STEP_S = 0.01
_END_S = 4.0  # for workers and operators
_BROKER_START_S = 15.0  # amqtt takes a while to import on a small machine
_TAIL = 2000  # characters of a log that are shown


def unchanged(command: Sequence[str]) -> Sequence[str]:
    return command


class Program:
    """A child process in a session of its own: Ctrl-C in a terminal reaches only its parent, which ends it in order.

    Start programs from the main thread: when the thread that started them ends, the kernel ends them. Only a program
    with input, such as a worker, is not tied to that thread: it ends when its input closes.
    """

    has_input: ClassVar = False

    def __init__(self, name: str, command: Sequence[str], log: Path, on_line: OnLine | None = None) -> None:
        """Start the program. ``on_line`` gets its lines of output, on another thread.

        Without ``on_line`` standard output is in the log, as errors are.
        """
        self.name, self.log = name, log
        with log.open("ab") as errors:
            self._process = subprocess.Popen(
                command if self.has_input else tied_to_parent(command, signal.SIGTERM),
                stdin=subprocess.PIPE if self.has_input else subprocess.DEVNULL,
                stdout=errors if on_line is None else subprocess.PIPE,
                stderr=errors,
                start_new_session=True,
            )
        self.pid = self._process.pid
        if on_line is not None:
            threading.Thread(target=self._read, args=(on_line,), name=f"output of {name}", daemon=True).start()

    @property
    def code(self) -> int | None:
        """Exit code of the program, once it has ended."""
        return self._process.poll()

    @property
    def ended(self) -> bool:
        return self.code is not None

    def tail(self) -> str:
        return self.log.read_text(errors="replace").strip()[-_TAIL:]

    def freeze(self) -> None:
        """Send SIGSTOP: its connections stay, and it answers nothing."""
        self._process.send_signal(signal.SIGSTOP)

    def thaw(self) -> None:
        self._process.send_signal(signal.SIGCONT)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()

    def wait_until(self, condition: Callable[[], bool], timeout: float, ending: threading.Event | None = None) -> None:
        """Wait for ``condition`` or ``ending``. Raises PebbleError on timeout, or if the program ends first."""
        end, ending = time.monotonic() + timeout, ending or threading.Event()
        while not condition() and not ending.wait(_STEP_S):
            if self.ended:
                last = "".join(self.tail().splitlines()[-1:])
                raise PebbleError(f"{self.name} ended with code {self.code}: {last or 'no output'}; see {self.log}")
            if time.monotonic() > end:
                raise PebbleError(f"{self.name} was not ready after {timeout:.0f} s: see {self.log}")

    def ask_to_end(self) -> None:
        if not self.ended:
            self._process.terminate()

    def _read(self, on_line: OnLine) -> None:
        for line in self._process.stdout or ():
            on_line(line)


class Worker(Program):
    """A program that reads lines, answers in JSON lines, and ends when its input does, also when this process dies.

    Its other end is worker_end.
    """

    has_input = True

    def __init__(self, name: str, command: Sequence[str], log: Path) -> None:
        self._answers: queue.Queue[dict[str, Any] | None] = queue.Queue()
        super().__init__(name, command, log, lambda line: self._answers.put(json.loads(line)))

    def answer(self, timeout: float) -> dict[str, Any]:
        """Return the next answer.

        Raises PebbleError with its log if it has ended, or does not answer within ``timeout`` s.
        """
        try:
            answer = self._answers.get(timeout=timeout)
        except queue.Empty:
            why = f"did not answer within {timeout:.0f} s"
        else:
            if answer is not None:
                return answer
            why = f"ended with code {self._process.wait()}"
        raise PebbleError(f"{self.name} {why}\n{self.tail()}".rstrip())

    def send(self, line: str) -> None:
        """Write a line to standard input. If the process has ended, nothing happens: :meth:`answer` reports that."""
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

    def _read(self, on_line: OnLine) -> None:
        super()._read(on_line)
        self._answers.put(None)  # no answer follows: the process has ended


def mosquitto_command(port: int, stem: Path, extra: Sequence[str] = (), host: str = HOST) -> list[str]:
    """Write a mosquitto's configuration to ``stem`` plus ``.conf``; return the command that runs it on ``port``."""
    path = mosquitto_path()
    if path is None:
        raise PebbleError("mosquitto is not installed: apt install mosquitto")
    config = stem.with_suffix(".conf")
    lines = [f"listener {port} {host}", "allow_anonymous true", "log_dest stderr", *extra]
    if os.geteuid() == 0:
        lines.append("user root")  # a change of user would undo the parent-death signal that Program sets
    config.write_text("\n".join(lines) + "\n")
    return [path, "-c", str(config)]


def free_port() -> int:
    """Return an unused TCP port, also where there is no loopback device.

    In a new network namespace every port is unused.

    The port is outside of the system's range for outgoing connections. Otherwise a client that tries again and again
    while its server is away would some day get that server's port, and be connected to itself.
    """
    while True:
        port = random.SystemRandom().randrange(*_PORTS)
        with socket.socket() as probe, suppress(OSError):
            probe.bind(("", port))
            return port


class Broker(Program):
    """A broker, which runs from its construction on."""

    def __init__(
        self,
        name: str,
        folder: Path,
        extra: Sequence[str] = (),
        *,
        host: str = HOST,
        wrap: Wrap = unchanged,
        program: str | None = None,
        port: int | None = None,
    ) -> None:
        """Start the broker. ``extra``: more lines of mosquitto's configuration.

        ``program``: a module to run at the port in mosquitto's place.
        """
        self.port = port or free_port()
        stem = folder / name
        command = python(program, self.port) if program else mosquitto_command(self.port, stem, extra, host)
        super().__init__(name, wrap(command), folder / f"{name}.log")

    def wait(self, ending: threading.Event | None = None) -> None:
        """Wait until the broker answers, or ``ending``. Raises PebbleError on timeout, or if it has ended."""
        self.wait_until(lambda: self._answers() and not self.ended, _BROKER_START_S, ending)

    def _answers(self) -> bool:
        with socket.socket() as probe:
            return probe.connect_ex((HOST, self.port)) == 0


P = TypeVar("P", bound=Program)


class Processes:
    """The processes of a run, with their folder.

    The end of the ``with`` block ends all of them, those of a kind at the same time; then it deletes the folder.
    """

    ends_s: ClassVar[tuple[float, ...]] = (_END_S, 6.0, 2.0, 2.0)  # by kind: seconds until processes are killed
    keep = False  # the folder is not deleted

    def __init__(self, prefix: str = "pbl-") -> None:
        usual = tempfile.gettempdir()  # mkdtemp makes a 0700 folder in it
        self.folder = Path(tempfile.mkdtemp(prefix=prefix, dir=usual if len(usual) <= _LONGEST_FOLDER else "/tmp"))  # noqa: S108
        self.workers: list[Worker] = []
        self._kinds: dict[Program, int] = {}

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            stack.push(self)  # ends what was started if a later process does not start
            self.start()
            stack.pop_all()
        return self

    def start(self) -> None:
        """Start the processes of a subclass. Called when the ``with`` block begins."""

    def __exit__(self, *_: object) -> None:
        for kind, within_s in enumerate(self.ends_s):
            end_all([program for program, its_kind in self._kinds.items() if its_kind == kind], within_s)
        if not self.keep:
            shutil.rmtree(self.folder, ignore_errors=True)

    def add(self, program: P, kind: int) -> P:
        self._kinds[program] = kind
        return program

    def end(self, program: Program) -> None:
        """End one process before the others."""
        end_all([program], self.ends_s[self._kinds.pop(program)])

    def unexpected_exits(self) -> list[str]:
        """Return the processes that have ended although they should run, brokers first."""
        programs = sorted(self._kinds, key=lambda program: -self._kinds[program])
        return [f"{program.name} ended unexpectedly: see {program.log}" for program in programs if program.ended]

    def worker(self, name: str, module: str, *arguments: object, wrap: Wrap = unchanged) -> Worker:
        return self.command(name, wrap(python(module, *arguments)))

    def command(self, name: str, command: Sequence[str]) -> Worker:
        """Return a worker that runs any command, not a module."""
        self.workers.append(self.add(Worker(name, command, self.folder / f"{name}.log"), OPERATORS))
        return self.workers[-1]

    def broker(self, name: str = "broker", folder: Path | None = None, **more: Any) -> Broker:
        """Start a broker and return it; wait for it before using it."""
        return self.add(Broker(name, folder or self.folder, **more), BROKERS)


def python(module: str, *arguments: object) -> list[str]:
    return [sys.executable, "-Pm", module, *map(str, arguments)]  # nothing of the folder that we are in


def end_all(programs: Iterable[Program], within_s: float = _END_S) -> None:
    """Send SIGTERM to all (to workers: the end of input); kill those that do not end in time, and their children."""
    programs, deadline = list(programs), time.monotonic() + within_s
    for program in programs:
        program.ask_to_end()
    for program in programs:
        try:
            program._process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            os.killpg(program.pid, signal.SIGKILL)
            program._process.wait()


def children(pid: int) -> list[int]:
    """Return the direct children of a process; none if it has ended.

    Not every kernel has /proc/PID/task/TID/children.
    """
    pids = []
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(FileNotFoundError, ProcessLookupError):  # it has ended meanwhile
            _state, parent, *_ = (process / "stat").read_text().rpartition(")")[2].split()  # what follows the name
            if int(parent) == pid:
                pids.append(int(process.name))
    return sorted(pids)
