"""One launcher per robot: the run directory and the lock file in it."""

from __future__ import annotations

import fcntl
import os
import stat
from pathlib import Path
from typing import Self

from pebble.errors import PebbleError

LOCK_NAME = "launcher.lock"


class RunLock:
    """Makes the run directory for this user alone and holds its lock; the kernel lets go however the process ends.

    Raises PebbleError when another process holds the lock, or when the directory is not ours to trust.
    """

    def __init__(self, run_dir: Path, robot: str) -> None:
        self._run_dir, self._robot = run_dir, robot
        self.path = run_dir / LOCK_NAME
        self._descriptor: int | None = None

    def take(self) -> Self:
        _make_private(self._run_dir)
        descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(descriptor, 32).decode(errors="replace").strip()
            os.close(descriptor)
            raise PebbleError(f"{self._robot} already runs: process {holder} holds {self.path}") from None
        os.truncate(descriptor, 0)
        os.write(descriptor, f"{os.getpid()}\n".encode())
        self._descriptor = descriptor
        return self

    def release(self) -> None:
        """Let go. The file stays: removing it would let two launchers lock two files of the same name."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None

    def __enter__(self) -> Self:
        return self.take()

    def __exit__(self, *_: object) -> None:
        self.release()


def _make_private(run_dir: Path) -> None:
    """Whoever can write here can drive the robot, and in /tmp somebody else may have prepared the names we use."""
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
