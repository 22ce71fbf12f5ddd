"""The USB serial port of a board: non-blocking reads and writes of single bytes. A driver.

MicroPython reads exactly as many bytes as requested and blocks for missing ones; a write blocks half a second for a
host that has the port open but reads nothing (shared/tinyusb/mp_usbd_cdc.c). So each byte is polled for and sent alone;
a board on which such a wait is harmless may set a larger ``chunk``.
"""

import sys
from select import POLLIN, POLLOUT, poll

from micropython import kbd_intr

if not hasattr(sys.stdin, "buffer"):
    raise ImportError


class Port:
    """``read`` returns bytes; ``send``, called often, sends those queued in ``out``. Ctrl-C is an ordinary byte."""

    chunk = 1

    def __init__(self, out) -> None:
        kbd_intr(-1)
        self._out = out
        self._byte = bytearray(1)
        self._readable, self._writable = poll(), poll()
        self._readable.register(sys.stdin, POLLIN)
        self._writable.register(sys.stdout, POLLOUT)

    def read(self) -> int:
        """Return the next byte from the host, -1 if there is none."""
        for _ in self._readable.ipoll(0):
            sys.stdin.buffer.readinto(self._byte)
            return self._byte[0]
        return -1

    def send(self) -> None:
        """Send as much as the host accepts."""
        out = self._out
        size = len(out.ring)
        while out.used:
            for _ in self._writable.ipoll(0):  # yields once if the host takes a byte
                break
            else:  # the host takes nothing now
                return
            sent = sys.stdout.buffer.write(out.ring, out.first, min(self.chunk, out.used, size - out.first)) or 0
            out.first = (out.first + sent) % size
            out.used -= sent
