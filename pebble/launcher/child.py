"""A child process of the launcher, with its pipes."""

import os
import signal
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import NoReturn

from pebble.config import Config
from pebble.extension import Program
from pebble.launcher.forked import become
from pebble.runtime.exits import exit_descriptor

_READ_BYTES = 65_536
_SIGNALS = signal.valid_signals()


class Child:
    """A process in its own process group: Ctrl-C in a terminal reaches only the launcher.

    ``output`` (stdout and stderr, in order), ``notes`` (pebble.runtime.notes) and ``exited`` are descriptors to wait
    on; ``exited`` is None where the process has to be polled (pebble.runtime.exits). The caller closes ``stdin``. The
    constructor forks: the caller must have one thread and no Zenoh session. Raises OSError.
    """

    def __init__(self, program: Program, environment: Mapping[str, str], config: Config, *, stdin: int) -> None:
        opened: list[int] = []
        try:
            self.notes, notes_end = _pipe(opened)
            self.output, output_end = _pipe(opened)
            os.set_blocking(output_end, True)  # else a program's output would fail while the pipe is full
            descriptors = {"stdin": stdin, "output": output_end, "notes": notes_end}
            self.pid = _fork(lambda: become(program, environment, config, **descriptors))
            self._reaped = False
            self.exited = self._watch_exit()
        except OSError:
            for descriptor in opened:
                os.close(descriptor)
            raise
        os.close(notes_end)
        os.close(output_end)

    def terminate(self) -> None:
        if not self._reaped:
            os.kill(self.pid, signal.SIGTERM)

    def kill(self) -> None:
        """Kill the child's process group. Safe at any time, also from a signal handler."""
        if self._reaped:  # the number may belong to another process by now
            return
        try:
            os.killpg(self.pid, signal.SIGKILL)
        except (ProcessLookupError, PermissionError):  # all have ended, or are another user's by sudo: the child alone
            os.kill(self.pid, signal.SIGKILL)

    def end(self) -> str:
        """Clean up after the child's exit; return ``exit code 1`` or ``signal 9``, for example."""
        self._reaped = True  # first: a signal handler may come in between
        code = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
        for descriptor in (self.output, self.notes, self.exited):
            if descriptor is not None:
                os.close(descriptor)
        return f"signal {-code}" if code < 0 else f"exit code {code}"

    def _watch_exit(self) -> int | None:
        try:
            return exit_descriptor(self.pid)
        except OSError:  # no descriptors left: a child whose end would go unnoticed must not live
            self.kill()
            os.waitpid(self.pid, 0)
            raise


def read_available(descriptor: int) -> bytes | None:
    """Return up to 64 KiB from a non-blocking pipe; empty at its end, None if there is nothing to read yet."""
    try:
        return os.read(descriptor, _READ_BYTES)
    except BlockingIOError:
        return None


def _pipe(opened: list[int]) -> tuple[int, int]:
    ends = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
    opened.extend(ends)
    return ends


def _fork(run: Callable[[], NoReturn]) -> int:
    """Fork, with signals blocked until ``run`` has set the child's handlers; return the child's process id."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        pid = os.fork()
        if pid == 0:
            run()
        with suppress(OSError):  # the child does the same: one of the two comes first
            os.setpgid(pid, pid)
        return pid
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
