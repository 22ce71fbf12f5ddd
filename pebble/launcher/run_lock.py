"""One launcher per robot: the run directory and the lock file in it."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Self

from pebble.errors import PebbleError
from pebble.runtime.parent import LAUNCHER_LOCK
from pebble.transports.peers import FileLock


class RunLock:
    """Makes the run directory for this user alone and holds its lock; the kernel releases it however the process ends.

    Raises PebbleError when another process holds the lock, or when the directory cannot be trusted.
    """

    def __init__(self, run_dir: Path, robot: str) -> None:
        self._run_dir, self._robot = run_dir, robot
        self.path = run_dir / LAUNCHER_LOCK
        self._lock: FileLock | None = None

    def take(self) -> Self:
        _make_private(self._run_dir)
        self._lock = FileLock.take(self.path)
        if self._lock is None:
            holder = self.path.read_text(errors="replace").strip()
            raise PebbleError(
                f"{self._robot} already runs: process {holder} holds {self.path}; end it there with Ctrl-C"
            )
        self._lock.write(f"{os.getpid()}\n".encode())
        return self

    def release(self) -> None:
        """Release the lock. The file stays, with the process id of the last launcher."""
        if self._lock is not None:
            self._lock.release(remove=False)
            self._lock = None

    def __enter__(self) -> Self:
        return self.take()

    def __exit__(self, *_: object) -> None:
        self.release()


def _make_private(run_dir: Path) -> None:
    """Write access here is control over the robot, and in /tmp another user may have created these names first."""
    try:
        run_dir.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if run_dir.parent.stat().st_uid not in (os.getuid(), 0):
            raise PebbleError(f"transport.run_dir {run_dir}: the folder it is in belongs to another user")
        run_dir.mkdir(mode=0o700, exist_ok=True)
        found = run_dir.lstat()
        if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid():
            raise PebbleError(f"transport.run_dir {run_dir} is not a folder of this user")
        if found.st_mode & 0o077:
            run_dir.chmod(0o700)
    except OSError as error:
        raise PebbleError(f"transport.run_dir {run_dir} cannot be used: {error.strerror}") from None
