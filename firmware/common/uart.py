"""A serial port on two pins, with non-blocking reads and writes: the driver in place of common/usb.py."""

from machine import UART, Pin
from micropython import const

_SERCOM = const(4)  # has PB08 as pad 0, PB09 as pad 1: D6 and D7 (ports/samd/mcu/samd21/pin-af-table.csv)
_BAUD = const(115200)
_BUFFER = const(64)


class Port:
    """``read`` returns bytes; ``send`` sends those queued in ``out``, and must be called often."""

    def __init__(self, out) -> None:
        self._out = out
        self._byte = bytearray(1)
        self._uart = UART(_SERCOM, _BAUD, tx=Pin("PB08"), rx=Pin("PB09"), timeout=0, rxbuf=_BUFFER, txbuf=2 * _BUFFER)

    def read(self) -> int:
        """Return the next byte from the host, -1 if there is none."""
        if not self._uart.any():
            return -1
        self._uart.readinto(self._byte)
        return self._byte[0]

    def send(self) -> None:
        """Send as much as fits the buffer. A full buffer is EAGAIN, which write() returns as None."""
        out = self._out
        size = len(out.ring)
        while out.used:
            count = min(_BUFFER, out.used, size - out.first)
            sent = self._uart.write(out.ring, out.first, count) or 0  # type: ignore[call-arg]  # (buffer, offset, length)
            out.first = (out.first + sent) % size
            out.used -= sent
            if sent < count:
                return
