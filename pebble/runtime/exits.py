"""Notices the end of a child process: by a descriptor or, where the system denies that, by polling."""

import errno
import logging
import os
from functools import cache

ASKS_S = 0.1  # how often to ask where there is no descriptor
_DENIED = (errno.EPERM, errno.ENOSYS)  # a container's filter, or an old kernel

log = logging.getLogger(__name__)


def exit_descriptor(pid: int) -> int | None:
    """Return a descriptor that is readable once the child has ended; None: poll :func:`has_ended`. Raises OSError."""
    try:
        return os.pidfd_open(pid)
    except OSError as error:
        if error.errno not in _DENIED:
            raise
        _warn(error.strerror)
        return None


def has_ended(pid: int) -> bool:
    """True if the child has ended; does not reap the child."""
    return os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None


@cache
def _warn(why: str) -> None:
    log.warning("pidfd_open is denied here (%s): ends of processes are noticed up to %g s late", why, ASKS_S)
