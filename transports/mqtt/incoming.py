"""How long received bytes may have waited in the kernel, which does not say when they arrived (T19)."""

from __future__ import annotations

import socket
import sys
from contextlib import suppress

try:
    import fcntl
    import termios
except ImportError:  # Windows has neither
    _can_measure = False
else:
    _can_measure = True


class WaitingTime:
    """Since when the bytes that are read next may have waited in a socket; all times are of one clock.

    Known is when the socket was last empty, and how many bytes were in it at another moment: what is read after these
    has arrived later.
    """

    def __init__(self, now: float) -> None:
        self.since = now
        self._checked_at = now  # all but the counted bytes have arrived since then
        self._counted = 0

    def empty(self, now: float) -> None:
        """The socket was empty at ``now``."""
        self._checked_at, self._counted = now, 0

    def found(self, size: int, now: float) -> None:
        """``size`` bytes are in the socket at ``now``."""
        if self._counted <= 0:
            self.since, self._checked_at, self._counted = self._checked_at, now, size

    def read(self, size: int) -> None:
        """``size`` bytes were taken out of it."""
        self._counted -= size


def readable_bytes(sock: socket.socket) -> int:
    """Bytes that the kernel has received and we have not read (FIONREAD); 0 where the system does not say."""
    size = bytearray(4)
    if not _can_measure:
        return 0
    with suppress(OSError, ValueError):  # closed, or no socket
        fcntl.ioctl(sock.fileno(), termios.FIONREAD, size)
    return int.from_bytes(size, sys.byteorder)
