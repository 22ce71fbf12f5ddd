"""A poll of a socket, which other threads can interrupt."""

import select
import socket
from math import ceil

from pebble.transports.wakeup import WakeupPipe

NOTHING = (False, False, False)  # is readable, writable, or was woken


class SocketPoll:
    """A poll that waits until a socket is readable, has an error or (with ``write``) is writable, or until `wake`."""

    def __init__(self) -> None:
        self._wakeup = WakeupPipe()
        self.registered = False
        self._sock, self._wake = -1, self._wakeup.fileno()  # descriptors
        self._write = False  # the poll waits also until the socket is writable
        self._poll = select.poll() if hasattr(select, "poll") else None  # Windows has none

    def register(self, sock: socket.socket) -> None:
        self.registered, self._sock = True, sock.fileno()
        if self._poll is not None:
            self._poll.register(self._sock, select.POLLIN)
            self._poll.register(self._wake, select.POLLIN)

    def wait(self, seconds: float, *, write: bool) -> tuple[bool, bool, bool]:
        """Return (readable, writable, woken) after at most this time."""
        if self._poll is None:
            readable, writable, woken = self._select(seconds, write=write)
        else:
            if write is not self._write:
                self._write = write
                self._poll.modify(self._sock, select.POLLIN | (select.POLLOUT if write else 0))
            readable = writable = woken = False
            for descriptor, events in self._poll.poll(ceil(seconds * 1000)):
                if descriptor == self._wake:
                    woken = True
                else:
                    readable = bool(events & ~select.POLLOUT)  # also with an error, as reading it says
                    writable = bool(events & select.POLLOUT)
        if woken:
            self._wakeup.clear()
        return readable, writable, woken

    def _select(self, seconds: float, *, write: bool) -> tuple[bool, bool, bool]:
        try:
            ready = select.select([self._sock, self._wake], [self._sock] if write else [], [self._sock], seconds)
        except (OSError, ValueError):  # closed meanwhile: reading it says so
            return True, False, False
        return self._sock in ready[0] + ready[2], bool(ready[1]), self._wake in ready[0]

    def wake(self) -> None:
        """Make `wait` return; other threads call it."""
        self._wakeup.set()

    def close(self) -> None:
        self._wakeup.close()
