"""Keeps a file from being cut while it is mapped: reading behind its new end would end the process (SIGBUS).

Readers of files that are not finished share a lock; finishing waits for them.
"""

import errno
import time
from pathlib import Path
from typing import BinaryIO, Final

_STEP_S: Final = 0.1


def share(file: BinaryIO) -> None:
    """Read ``file`` until it is closed; waits while it is being finished. Raises OSError."""
    try:
        import fcntl
    except ImportError:  # Windows, which cuts no file that is mapped
        return
    fcntl.flock(file, fcntl.LOCK_SH)


def own(file: BinaryIO, path: Path, wait_s: float) -> None:
    """Wait until it is not read. Raises OSError after ``wait_s`` seconds."""
    try:
        import fcntl
    except ImportError:
        return
    end = time.monotonic() + wait_s
    while True:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= end:
                raise OSError(errno.EBUSY, "is being read: try again later", str(path)) from None
            time.sleep(_STEP_S)
        else:
            return
