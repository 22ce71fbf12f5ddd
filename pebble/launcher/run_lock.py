"""One launcher per robot: the run directory and the lock file in it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Self

from pebble.errors import PebbleError
from pebble.runtime.parent import LAUNCHER_LOCK
from pebble.transports.peers import FileLock, make_private


class RunLock:
    """Makes the run directory for this user alone and holds its lock; the kernel releases it however the process ends.

    Raises PebbleError when another process holds the lock, or when the directory cannot be trusted.
    """

    def __init__(self, run_dir: Path, robot: str) -> None:
        self._run_dir, self._robot = run_dir, robot
        self.path = run_dir / LAUNCHER_LOCK
        self._lock: FileLock | None = None

    def take(self) -> Self:
        make_private(self._run_dir, close=True)
        self._lock = FileLock.take(self.path)
        if self._lock is None:
            holder = self.path.read_text(errors="replace").strip("\0\n") or "(unknown)"
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
