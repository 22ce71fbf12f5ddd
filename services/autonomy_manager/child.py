"""The process of a script: it is started, read, signalled, and watched until it ends."""

import logging
import os
import re
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from msgspec import Struct

from pebble.errors import PebbleError
from pebble.extensions.media.child import Child
from pebble.runtime.bounded_output import PAUSE_S, BoundedOutput
from pebble.runtime.exits import ASKS_S, exit_descriptor, has_ended
from pebble.runtime.parent import tagged
from pebble.services.autonomy_manager.guard import Guard

_READ_BYTES = 65_536
_LAST_READS = 16  # of what it left in its pipe when it ended
_LONGEST_LINE = 3500  # bytes; with its tag it fits into one write that no other can interrupt (PIPE_BUF)
_TICK_MS = 500
_LONGEST_FIRST_LINE = 256  # bytes that the kernel reads of it

log = logging.getLogger(__name__)


class Launch(Struct, frozen=True):
    """The parameters of a process. ``file`` names it in the log; it gets the signal ``tie`` if its parent dies."""

    file: str
    command: tuple[str, ...]
    folder: Path
    environment: dict[str, str]
    tie: signal.Signals


class Processes:
    """A starter of real processes. Main thread only: the kernel ties a process to the thread that starts it."""

    def __init__(self, lock: Path) -> None:
        self._guard = Guard(lock)

    def __call__(self, launch: Launch, ended: Callable[[int], None]) -> "Process":
        """Start a process; ``ended`` gets its exit code, or minus the signal that ended it, on any thread.

        The first call waits until no script of an earlier manager lives. Raises PebbleError if one does not end.
        """
        self._guard.begin()
        process = Process(launch)
        try:
            release = self._guard.watch(process.pid, launch.tie)
        except OSError:
            process.signal(signal.SIGKILL)
            process.watch(lambda _code: None)  # reaps it
            raise

        def on_end(code: int) -> None:
            release()
            ended(code)

        process.watch(on_end)
        return process

    def close(self) -> None:
        self._guard.close()


class Process:
    """A running process, with the thread that reads its output and waits for its end."""

    def __init__(self, launch: Launch) -> None:
        _check_program(Path(launch.command[0]))
        output = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        self._child = Child(launch.command, launch.environment, launch.folder, launch.tie, **output)
        self.pid = self._child.pid
        self._file = launch.file
        self._thread: threading.Thread | None = None

    def watch(self, ended: Callable[[int], None]) -> None:
        """Start reading the output and waiting for the end; ``ended`` gets the exit code."""
        self._thread = threading.Thread(target=self._watch, args=(ended,), name=f"script {self._file}", daemon=True)
        self._thread.start()

    def signal(self, number: signal.Signals) -> None:
        self._child.signal(number)

    def wait(self, timeout_s: float) -> None:
        if self._thread is not None:
            self._thread.join(max(0.0, timeout_s))

    # -- on its thread

    def _watch(self, ended: Callable[[int], None]) -> None:
        try:
            self._read_until_exit()
        except OSError:
            log.exception("the output of %s cannot be read", self._file)
        self._child.pipe("stdout").close()
        ended(self._child.finish(0.0))

    def _read_until_exit(self) -> None:
        """Read the output until the process has ended. It is not reaped here."""
        pipe = self._child.pipe("stdout").fileno()
        output = BoundedOutput(self._write, _LONGEST_LINE, time.monotonic())
        os.set_blocking(pipe, False)
        exited = exit_descriptor(self.pid)
        poll = select.poll()
        poll.register(pipe, select.POLLIN)
        if exited is not None:
            poll.register(exited, select.POLLIN)
        tick_ms = _TICK_MS if exited is not None else round(1000 * ASKS_S)  # without a descriptor, ask often
        try:
            has_exited = False
            while not has_exited:
                ready = dict(poll.poll(tick_ms))
                has_exited = has_ended(self.pid) if exited is None else exited in ready
                output.tick(time.monotonic())
                if pipe in ready and not _read(pipe, output):
                    poll.unregister(pipe)  # it closed its stdout and stderr
                if output.flooded:
                    time.sleep(PAUSE_S)
            for _ in range(_LAST_READS):  # not without end: programs that it started may still write
                if not _read(pipe, output):
                    break
            output.end()
        finally:
            if exited is not None:
                os.close(exited)

    def _write(self, line: bytes) -> None:
        sys.stderr.flush()
        with suppress(OSError):
            os.write(sys.stderr.fileno(), tagged(self._file, self.pid, line))


def _check_program(path: Path) -> None:
    """Raise PebbleError for a missing interpreter, which the kernel would report as a missing script."""
    if not path.is_file():
        return
    if not os.access(path, os.X_OK):
        raise PebbleError(f"{path} is not executable: chmod +x {path}")
    with suppress(OSError), path.open("rb") as file:
        first = file.readline(_LONGEST_FIRST_LINE)
        interpreter = os.fsdecode(re.split(rb"[ \t\n]", first[2:])[0]) if first.startswith(b"#!/") else ""
        if interpreter and not Path(interpreter).is_file():
            raise PebbleError(f"{path}: there is no {interpreter!r}, which its first line names")


def _read(pipe: int, output: BoundedOutput) -> bool:
    """Read the available output; return False if nothing was available, or at the end of the pipe."""
    try:
        data = os.read(pipe, _READ_BYTES)
    except BlockingIOError:
        return False
    output.feed(data, time.monotonic())
    return bool(data)


#: Starts a process, as :class:`Processes` does.
Spawn = Callable[[Launch, Callable[[int], None]], Process]
