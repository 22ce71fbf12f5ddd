"""Zenoh's shared memory segments: files in /dev/shm, locked by each process that uses them."""

import fcntl
import os
import time
from pathlib import Path

SHM = Path("/dev/shm")  # noqa: S108 - where POSIX shared memory is on Linux
YOUNG_S = 1.0  # a segment is locked within a second after its creation


def sweep() -> int:
    """Remove the segments of this user that no process uses any more; return how many were removed."""
    return sum(map(_remove_if_unused, SHM.glob("*.zenoh")))


def _remove_if_unused(segment: Path) -> bool:
    try:
        descriptor = os.open(segment, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:  # of another user, or gone
        return False
    try:
        status = os.fstat(descriptor)
        if status.st_uid != os.geteuid() or time.time() - status.st_ctime < YOUNG_S:  # another's, or not locked yet
            return False
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        segment.unlink(missing_ok=True)
    except OSError:  # in use, or not ours
        return False
    finally:
        os.close(descriptor)
    return True
