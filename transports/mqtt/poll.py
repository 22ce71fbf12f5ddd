"""A poll of a socket, from which other threads can wake the one that waits."""

import select
import socket
from math import ceil

from pebble.transports.wakeup import WakeupPipe

NOTHING = (False, False, False)  # is readable, writable, or was woken


class SocketPoll:
    """A wait until a socket is readable or has an error, or (with ``write``) writable, or `wake` was called."""

    def __init__(self) -> None:
        self._wakeup = WakeupPipe()
        self.registered = False
        self._sock, self._wake, self._write = -1, self._wakeup.fileno(), False
        self._poll = select.poll()

    def register(self, sock: socket.socket) -> None:
        self.registered, self._sock = True, sock.fileno()
        self._poll.register(self._sock, select.POLLIN)
        self._poll.register(self._wake, select.POLLIN)

    def wait(self, seconds: float, *, write: bool) -> tuple[bool, bool, bool]:
        """Return which of the three holds: readable, writable, woken."""
        if write is not self._write:
            self._write = write
            self._poll.modify(self._sock, select.POLLIN | (select.POLLOUT if write else 0))
        readable = writable = woken = False
        for descriptor, seen in self._poll.poll(ceil(seconds * 1000)):
            if descriptor == self._wake:
                woken = True
            else:
                readable, writable = bool(seen & ~select.POLLOUT), bool(seen & select.POLLOUT)
        if woken:
            self._wakeup.clear()
        return readable, writable, woken

    def wake(self) -> None:
        """Make `wait` return; other threads call it."""
        self._wakeup.set()

    def close(self) -> None:
        self._wakeup.close()
