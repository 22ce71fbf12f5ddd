"""A guard that ends all script processes when this process has ended, before another manager starts."""

import logging
import os
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

from pebble.errors import PebbleError
from pebble.extensions.scripts.runs import locked_within
from pebble.runtime.environment import child_environment

# At the end of its input, this process has ended. A process that is killed cannot do this itself, and the kernel's
# parent death signal reaches only a script's first process. A shell is the smallest program there is for it.
_PROGRAM = """
await() { tries=$1; while [ "$tries" -gt 0 ] && kill -s 0 -- "-$group"; do tries=$((tries - 1)); sleep 0.02; done; }
group=$2
read -r _
kill -s "$1" -- "-$group"
await 20
kill -s KILL -- "-$group"
await 50
"""
_LOCKED_S = 5.0  # longer than the program takes

log = logging.getLogger(__name__)


class Guard:
    """A starter of small programs, one for each script, that outlive this process until no script is left.

    They hold ``lock``, for which the next manager of scripts waits: scripts of two managers never run at once.
    """

    def __init__(self, lock: Path) -> None:
        self._path, self._descriptor = lock, -1  # of the lock while this process has it open, else -1

    def begin(self) -> None:
        """Wait until the guard of an earlier process has ended. Raises PebbleError if it does not."""
        if self._descriptor >= 0:
            return
        try:
            self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC, 0o600)
        except OSError as error:
            log.warning("%s cannot be opened: %s", self._path, error.strerror)
            return  # scripts run all the same, as where the file system has no locks
        try:
            if not locked_within(_LOCKED_S, self._descriptor):
                self.close()
                raise PebbleError(f"scripts of an earlier process are still running: end what has {self._path} open")
        except OSError as error:  # a file system without locks, where scripts run all the same
            log.warning("%s cannot be locked: %s", self._path, error.strerror)

    def watch(self, group: int, number: signal.Signals) -> Callable[[], None]:
        """Start a helper that ends a process group if this process dies: with signal ``number``, then SIGKILL.

        Return a function that ends the helper; call it when the group has ended. Raises OSError.
        """
        helper = subprocess.Popen(
            ["sh", "-c", _PROGRAM, "sh", number.name.removeprefix("SIG"), str(group)],
            env=child_environment(),
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # a kill of this process's group must not reach it
            pass_fds=() if self._descriptor < 0 else (self._descriptor,),
        )

        def call_off() -> None:
            helper.kill()
            helper.communicate()

        return call_off

    def close(self) -> None:
        """Let the next manager start, once no script is left."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1
