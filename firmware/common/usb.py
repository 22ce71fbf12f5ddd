"""The USB serial port of a board as single bytes, in and out, that never block. A driver.

MicroPython reads exactly as many bytes as it is asked for and waits for the missing ones; and it waits half a second
for a host that has the port open but reads nothing (shared/tinyusb/mp_usbd_cdc.c). So each byte is polled for, and
what leaves goes byte by byte; a board on which such a wait hurts nobody may set a larger ``piece``.
"""

import sys
from select import POLLIN, POLLOUT, poll

from micropython import kbd_intr

if not hasattr(sys.stdin, "buffer"):
    raise ImportError


class Port:
    """``read`` bytes, and ``pump`` often what waits in the ring of ``out``. Ctrl-C is a byte like any other."""

    piece = 1

    def __init__(self, out) -> None:
        kbd_intr(-1)
        self._out = out
        self._byte = bytearray(1)
        self._readable, self._writable = poll(), poll()
        self._readable.register(sys.stdin, POLLIN)
        self._writable.register(sys.stdout, POLLOUT)

    def read(self) -> int:
        """The next byte from the host, -1 if there is none."""
        for _ in self._readable.ipoll(0):
            sys.stdin.buffer.readinto(self._byte)
            return self._byte[0]
        return -1

    def pump(self) -> None:
        """Pass on what the host takes."""
        out = self._out
        size = len(out.ring)
        while out.used:
            for _ in self._writable.ipoll(0):
                break
            else:
                return
            sent = sys.stdout.buffer.write(out.ring, out.first, min(self.piece, out.used, size - out.first)) or 0
            out.first = (out.first + sent) % size
            out.used -= sent
