"""Ends all processes of all scripts when this process has ended, however it ended, before the next one begins."""

import fcntl
import logging
import os
import signal
import subprocess
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from pebble.errors import PebbleError
from pebble.runtime.environment import child_environment

# Each line of its input is the whole list, "TERM:123 KILL:456"; at the end of the input, this process has ended.
# A process that is killed cannot do this itself, and the kernel's parent death signal reaches only a script's first
# process. A shell is the smallest program there is for it.
_PROGRAM = """
left() { for group in $groups; do kill -s 0 -- "-${group##*:}" && return; done; return 1; }
await() { tries=$1; while [ "$tries" -gt 0 ] && left; do tries=$((tries - 1)); sleep 0.02; done; }
while read -r line; do groups=$line; done
for group in $groups; do kill -s "${group%%:*}" -- "-${group##*:}"; done
await 20
for group in $groups; do kill -s KILL -- "-${group##*:}"; done
await 50
"""
_LOCKED_S = 5.0  # longer than the program takes
_TRY_S = 0.02

log = logging.getLogger(__name__)


class Guard:
    """A small process that outlives this one until no script is left. It runs from the first script on. Any thread.

    It holds ``lock``, which the next manager of scripts waits for: never are scripts of two managers alive.
    """

    def __init__(self, lock: Path) -> None:
        self._path, self._locked = lock, -1
        self._lock = threading.Lock()
        self._groups: dict[int, signal.Signals] = {}
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe = -1  # its input, while there is one

    def begin(self) -> None:
        """Wait until the guard of an earlier process has ended. Raises PebbleError if it does not."""
        if self._locked >= 0:
            return
        try:
            self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._locked = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC, 0o600)
        except OSError as error:
            log.warning("%s cannot be opened: %s", self._path, error.strerror)
            return
        deadline = time.monotonic() + _LOCKED_S
        while not self._try_to_lock():
            if time.monotonic() > deadline:
                self._unlock()
                raise PebbleError(f"scripts of an earlier process are still running: end what has {self._path} open")
            time.sleep(_TRY_S)

    def add(self, group: int, number: signal.Signals) -> None:
        """End this process group with ``number``, and with SIGKILL if it has not ended then. Raises OSError."""
        with self._lock:
            self._groups[group] = number
            self._update(self._groups)

    def remove(self, group: int) -> None:
        with self._lock, suppress(OSError):
            self._groups.pop(group, None)
            self._update(self._groups)

    def close(self) -> None:
        """End it without ending anything else."""
        with self._lock:
            if self._process is not None:
                with suppress(OSError):
                    self._write({})
                self._end()
            self._unlock()

    def _unlock(self) -> None:
        if self._locked >= 0:
            os.close(self._locked)
            self._locked = -1

    def _try_to_lock(self) -> bool:
        try:
            fcntl.flock(self._locked, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True

    def _update(self, groups: Mapping[int, signal.Signals]) -> None:
        if self._process is not None:
            try:
                self._write(groups)
                return
            except BrokenPipeError:  # it was killed
                self._end()
        read_end, self._pipe = os.pipe2(os.O_CLOEXEC)
        os.set_blocking(self._pipe, False)
        try:
            self._process = self._start(read_end)
        except OSError:
            os.close(self._pipe)
            raise
        finally:
            os.close(read_end)
        self._write(groups)

    def _start(self, read_end: int) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            ["sh", "-c", _PROGRAM],
            env=child_environment(),
            stdin=read_end,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # a kill of this process's group must not reach it
            pass_fds=() if self._locked < 0 else (self._locked,),
        )

    def _end(self) -> None:
        """It ends with its input."""
        process, self._process = self._process, None
        os.close(self._pipe)
        if process is not None:
            process.wait()

    def _write(self, groups: Mapping[int, signal.Signals]) -> None:
        words = (f"{number.name.removeprefix('SIG')}:{group}" for group, number in groups.items())
        os.write(self._pipe, (" ".join(words) + "\n").encode())
