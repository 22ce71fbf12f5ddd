"""The locks that allow one launcher per robot: a file in its run directory and one in its state directory."""

import logging
import os
from pathlib import Path
from typing import Self

from pebble.config import LAUNCHER_LOCK
from pebble.errors import PebbleError, TransportError
from pebble.runtime.as_owner import require_own
from pebble.transports.peers import FileLock, make_private

log = logging.getLogger(__name__)


class RunLock:
    """The lock of a run directory, which is made for this user alone. The kernel releases it when the process ends.

    A second lock, in the state directory, also excludes launchers that were started with another run directory.

    Raises PebbleError when another process holds a lock, or when the directory cannot be trusted.
    """

    def __init__(self, run_dir: Path, robot: str, state_lock: Path) -> None:
        self._run_dir, self._robot, self._state_path = run_dir, robot, state_lock
        self.path = run_dir / LAUNCHER_LOCK
        self._lock: FileLock | None = None
        self._state_lock: FileLock | None = None
        self._problem = ""  # as last logged

    def take(self) -> Self:
        """Create the directory, and take both locks."""
        make_private(self._run_dir, close=True)
        self._lock = self._taken(self.path)
        try:
            require_own(self._state_path.parent)
            self._state_path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._state_lock = self._taken(self._state_path)
        except (OSError, TransportError) as error:  # no lock can be made there: that of the run directory has to do
            log.warning("a launcher with another run directory is not noticed: %s", error)
        except PebbleError:  # another launcher holds it, or root must not write there
            self.release()
            raise
        self._write()
        return self

    def _taken(self, path: Path) -> FileLock:
        if (lock := FileLock.take(path)) is not None:
            return lock
        holder = path.read_text(errors="replace", encoding="utf-8").strip("\0\n").partition("\n")[0] or "(unknown)"
        raise PebbleError(f"{self._robot} already runs: process {holder} holds {path}; end it there with Ctrl-C")

    def _write(self) -> None:
        for lock in (self._lock, self._state_lock):
            if lock is not None:
                lock.write(f"{os.getpid()}\n{self._robot}\n".encode())

    def keep(self) -> bool:
        """Create the directory and the lock again if a cleaner or a logout has removed them. Call this every second.

        True if they were created: programs that start now cannot reach those that were already running. Raises
        PebbleError if another launcher has taken the lock.
        """
        lock = self._lock
        try:
            if lock is None or lock.in_place:
                return False
            make_private(self._run_dir, close=True)
            fresh = FileLock.take(self.path)
        except (OSError, PebbleError) as error:
            self._log_once(str(error))
            return False
        if fresh is None:
            raise PebbleError(f"{self.path} was removed, and another launcher holds it now: this robot stops")
        lock.release()
        self._lock, self._problem = fresh, ""
        self._write()
        return True

    def _log_once(self, problem: str) -> None:
        if problem != self._problem:
            text = "what starts again reaches none of the robot's other processes until it can be made again"
            log.error("%s was removed: %s: %s", self._run_dir, text, problem)
        self._problem = problem

    def release(self) -> None:
        """Release the locks. The files stay, with the process id of the last launcher and its robot."""
        for lock in (self._lock, self._state_lock):
            if lock is not None:
                lock.release(remove=False)
        self._lock = self._state_lock = None

    def __enter__(self) -> Self:
        return self.take()

    def __exit__(self, *_: object) -> None:
        self.release()
