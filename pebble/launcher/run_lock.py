"""One launcher per robot: the run directory with the lock file in it, and a name that other launchers find."""

import logging
import os
from pathlib import Path
from typing import Self

from pebble.config import LAUNCHER_LOCK
from pebble.errors import PebbleError
from pebble.launcher.machine_name import MachineName
from pebble.transports.peers import FileLock, make_private

log = logging.getLogger(__name__)


class RunLock:
    """Makes the run directory for this user alone and holds its lock; the kernel releases it however the process ends.

    A second lock is independent of the environment, which determines the run directory: a name, of which there is one
    on a machine for a robot and the config file it is started from.

    Raises PebbleError when another process holds a lock, or when the directory cannot be trusted.
    """

    def __init__(self, run_dir: Path, robot: str, config: Path) -> None:
        self._run_dir, self._robot, self._config = run_dir, robot, config
        self.path = run_dir / LAUNCHER_LOCK
        self._lock: FileLock | None = None
        self._name: MachineName | None = None
        self._problem = ""

    def take(self) -> Self:
        make_private(self._run_dir, close=True)
        self._lock = FileLock.take(self.path)
        if self._lock is None:
            holder = (
                self.path.read_text(errors="replace", encoding="utf-8").strip("\0\n").partition("\n")[0] or "(unknown)"
            )
            raise PebbleError(
                f"{self._robot} already runs: process {holder} holds {self.path}; end it there with Ctrl-C"
            )
        try:
            self._name = MachineName.take(self._robot, self._config)
        except PebbleError:
            self.release()
            raise
        self._write()
        return self

    def _write(self) -> None:
        if self._lock is not None:
            self._lock.write(f"{os.getpid()}\n{self._robot}\n".encode())

    def keep(self) -> None:
        """Make the directory and the lock again if they were removed, by a cleaner or a logout; call it every second.

        It also answers the launchers that ask who holds the robot's name. Raises PebbleError if another launcher has
        taken the lock.
        """
        if self._name is not None:
            self._name.answer()
        lock, problem = self._lock, ""
        try:
            if lock is None or lock.in_place:
                return
            make_private(self._run_dir, close=True)
            fresh = FileLock.take(self.path)
        except (OSError, PebbleError) as error:
            problem = str(error)
        else:
            if fresh is None:
                raise PebbleError(f"{self.path} was removed, and another launcher holds it now: this robot stops")
            lock.release()
            self._lock = fresh
            self._write()
            log.warning("%s was removed: it is made again", self.path)
        if problem and problem != self._problem:
            log.error(
                "%s was removed: what starts again reaches none of the robot's other processes until it can be made "
                "again: %s",
                self._run_dir,
                problem,
            )
        self._problem = problem

    def release(self) -> None:
        """Release the locks. The file stays, with the process id of the last launcher and its robot."""
        if self._name is not None:
            self._name.close()
            self._name = None
        if self._lock is not None:
            self._lock.release(remove=False)
            self._lock = None

    def __enter__(self) -> Self:
        return self.take()

    def __exit__(self, *_: object) -> None:
        self.release()
