"""A child process of a service, in a process group of its own, which ends with the service in any case."""

import errno
import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

_POLL_S = 0.01


class Child:
    """A running program. The programs that it starts are killed when it has ended. Any thread may call any method.

    When the thread that starts it has ended, it gets the signal ``tie``, by default SIGKILL. ``streams`` are ``stdin``
    (nothing unless given), ``stdout`` and ``stderr``, as in subprocess. Raises OSError and ValueError if it cannot be
    started.
    """

    def __init__(
        self,
        command: Sequence[str],
        environment: Mapping[str, str],
        cwd: Path | None = None,
        tie: signal.Signals | None = None,
        **streams: Any,
    ) -> None:
        self._process: subprocess.Popen[bytes] = subprocess.Popen(
            tied_to_parent(command, tie),
            cwd=cwd,
            env=environment,
            start_new_session=True,
            **{"stdin": subprocess.DEVNULL, **streams},
        )
        self.pid = self._process.pid
        self.code: int | None = None  # of its exit, or minus the signal that ended it; None until that is noticed
        self._lock = threading.Lock()  # no signal once it is reaped: its number may be another process's by then

    def pipe(self, name: str) -> IO[bytes]:
        """Return our end of a stream for which ``subprocess.PIPE`` was given."""
        stream: IO[bytes] = getattr(self._process, name)
        return stream

    def signal(self, number: int) -> None:
        """Send a signal to the program's group, if the program still runs."""
        with self._lock:
            if self.code is None:
                with suppress(ProcessLookupError):
                    os.killpg(self.pid, number)

    def wait(self, timeout_s: float = float("inf")) -> int | None:
        """Wait for the program's end, at most ``timeout_s``; return its exit code, None if it still runs."""
        deadline = time.monotonic() + timeout_s
        while self.code is None and not self._has_ended(wait=timeout_s == float("inf")):
            if time.monotonic() >= deadline:
                return None
            time.sleep(_POLL_S)
        with self._lock:
            if self.code is None:
                with suppress(ProcessLookupError, PermissionError):
                    os.killpg(self.pid, signal.SIGKILL)  # the programs that it started
                self.code = self._process.wait()
        return self.code

    def finish(self, timeout_s: float) -> int:
        """Wait for the program's end, at most ``timeout_s``, then kill it; return its exit code."""
        if self.wait(timeout_s) is None:
            self.signal(signal.SIGKILL)
        return self.wait() or 0

    def watch(self, ended: Callable[[int], None]) -> None:
        """Call ``ended(code)`` on another thread when the program has ended."""
        name = f"pebble-child {self.pid}"
        threading.Thread(target=lambda: ended(self.wait() or 0), name=name, daemon=True).start()

    def _has_ended(self, *, wait: bool) -> bool:
        """True if the program is a zombie, or was reaped by another thread. ``wait``: for the program's end."""
        try:
            return os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOWAIT | (0 if wait else os.WNOHANG)) is not None
        except ChildProcessError:
            return True


def how_ended(code: int) -> str:
    """Return an exit code in words: ``exit code 1`` or ``signal 9``."""
    return f"exit code {code}" if code >= 0 else f"signal {-code}"


def tied_to_parent(command: Sequence[str], number: signal.Signals | None = None) -> list[str]:
    """Return ``command`` extended so that the process gets a signal when the thread that starts it has ended.

    ``number``: the signal, by default SIGKILL. This holds from some milliseconds after the start, when setpriv has
    asked the kernel for it. Raises FileNotFoundError if there is no such program. ``preexec_fn`` does not do: between
    fork and exec, Python 3.11.2 may wait for ever for a lock that a thread of Zenoh held.
    """
    if shutil.which(command[0]) is None:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), command[0])
    name = (signal.SIGKILL if number is None else number).name.removeprefix("SIG")
    return ["setpriv", "--pdeathsig", name, "--", *command]
