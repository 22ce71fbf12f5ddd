"""The USB serial port of a board whose MicroPython has no select: lines of text only. It replaces usb.py. A driver.

Without select, reading always blocks. So the program blocks on input (``listen``), and a timer runs the robot's turns:
MicroPython runs timer callbacks while it waits (ports/samd/mphalport.c, mp_hal_stdin_rx_chr). Writing blocks up to half
a second for a host that has the port open but reads nothing; after one such wait, nothing is written for a second.
"""

import sys
import time

import machine
from micropython import const, kbd_intr

from common.ticks import diff

_TURN_MS = const(5)
_RING = const(64)
_SLOW_MS = const(100)
_PAUSE_MS = const(1000)
_CR = const(13)


class Port:
    """``read`` returns bytes; ``send``, called often, sends those queued in ``out``. Ctrl-C is an ordinary byte."""

    def __init__(self, out) -> None:
        kbd_intr(-1)
        self._out = out
        self._ring = bytearray(_RING)
        self._put = self._got = 0  # each is changed by one side only
        self._stuck_at: int | None = None

    def listen(self, robot, watchdog) -> None:
        """Receive from the host for ever, while a timer runs the robot's turn every 5 ms."""
        self._robot, self._watchdog = robot, watchdog
        self._timer = machine.Timer(-1, period=_TURN_MS, callback=self._turn)
        byte = bytearray(1)
        while True:
            sys.stdin.readinto(byte)  # type: ignore[misc]  # here text streams have it too
            after = (self._put + 1) % _RING
            while after == self._got:  # the ring is full until a turn reads
                time.sleep_ms(1)
            self._ring[self._put] = byte[0]
            self._put = after

    def _turn(self, _timer) -> None:
        """Run a turn and handle errors as common/run.py does, which does not see exceptions of a callback."""
        try:
            self._robot.step()
            self._watchdog.feed()
        except Exception:  # noqa: BLE001 - on any error: stop and reset
            self._robot.stop()
            machine.reset()

    def read(self) -> int:
        """Return the next byte from the host, -1 if there is none. A CR arrives as LF."""
        if self._got == self._put:
            return -1
        byte = self._ring[self._got]
        self._got = (self._got + 1) % _RING
        return byte

    def send(self) -> None:
        """Send the bytes queued in ``out`` to the host, without CR: the port itself writes LF as CR LF."""
        out = self._out
        size = len(out.ring)
        while out.used:
            began = time.ticks_ms()
            if self._stuck_at is not None and 0 <= diff(began, self._stuck_at) < _PAUSE_MS:
                out.used = 0
                return
            most = min(out.used, size - out.first)
            count = 0
            while count < most and out.ring[out.first + count] != _CR:
                count += 1
            if count:
                sys.stdout.write(out.ring, out.first, count)  # type: ignore[call-overload]  # (buffer, offset, length)
            count += count < most  # and 1 if a CR ended the loop: it is left out
            out.first = (out.first + count) % size
            out.used -= count
            now = time.ticks_ms()
            self._stuck_at = now if diff(now, began) > _SLOW_MS else None
