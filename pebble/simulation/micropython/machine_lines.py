"""``I2C`` and ``UART`` of a simulated board."""

from __future__ import annotations

import errno
from typing import TYPE_CHECKING, Any

from pebble.simulation.micropython.faults import failure
from pebble.simulation.micropython.i2c import Bus, Device
from pebble.simulation.micropython.streams import POLLIN, POLLOUT

if TYPE_CHECKING:
    from pebble.simulation.micropython.board import Board


class SimulatedI2c:
    """``I2C``, ``SoftI2C``: transfers with the devices on the board's bus; OSError ENODEV where none answers."""

    _board: Board

    def __init__(self, *_id: int, scl: Any = None, sda: Any = None, freq: int = 400_000, timeout: int = 50_000) -> None:
        del scl, sda, freq, timeout
        self._bus: Bus = self._board.bus

    def init(self, **settings: Any) -> None:
        """Nothing that could be seen from outside."""

    def deinit(self) -> None: ...

    def scan(self) -> list[int]:
        return self._bus.addresses()

    def writeto(self, addr: int, buf: bytes, stop: bool = True) -> int:
        del stop
        self._bus.device(addr).write(bytes(buf))
        return len(buf)

    def readfrom(self, addr: int, nbytes: int, stop: bool = True) -> bytes:
        del stop
        return _read(self._bus.device(addr), nbytes)

    def readfrom_into(self, addr: int, buf: bytearray, stop: bool = True) -> None:
        buf[:] = self.readfrom(addr, len(buf), stop)

    def writeto_mem(self, addr: int, memaddr: int, buf: bytes, *, addrsize: int = 8) -> None:
        self._bus.device(addr).write(memaddr.to_bytes(addrsize // 8, "big") + bytes(buf))

    def readfrom_mem(self, addr: int, memaddr: int, nbytes: int, *, addrsize: int = 8) -> bytes:
        device = self._bus.device(addr)
        device.write(memaddr.to_bytes(addrsize // 8, "big"))
        return _read(device, nbytes)

    def readfrom_mem_into(self, addr: int, memaddr: int, buf: bytearray, *, addrsize: int = 8) -> None:
        buf[:] = self.readfrom_mem(addr, memaddr, len(buf), addrsize=addrsize)


def _read(device: Device, count: int) -> bytes:
    data = device.read(count)
    if len(data) != count:
        raise failure(errno.EIO)
    return data


class SimulatedUart:
    """``UART``: the other end is the host, as it is of USB."""

    _board: Board

    def __init__(self, _number: int, baudrate: int = 9600, **_settings: Any) -> None:
        self.baudrate = baudrate
        self._board.console.interrupt = -1  # Ctrl-C is for USB
        self._console = self._board.console

    def any(self) -> int:
        return self._console.unread

    def read(self, count: int = -1) -> bytes | None:
        """What there is, at most ``count`` bytes; None if there is nothing."""
        waiting = self._console.unread
        return bytes(self._console.take(waiting if count < 0 else min(count, waiting))) if waiting else None

    def readinto(self, buffer: bytearray | memoryview, count: int = -1) -> int | None:
        data = self.read(len(buffer) if count < 0 else min(count, len(buffer)))
        if data is None:
            return None
        buffer[: len(data)] = data
        return len(data)

    def write(self, data: Any, *span: int) -> int | None:
        """``write(data)``, ``write(data, length)`` or ``write(data, offset, length)``; None if nothing was taken."""
        start, length = (0, *span)[-2:] if span else (0, len(data))
        return self._console.write(data[start : start + length]) or None

    def ready(self, mask: int) -> int:
        return (mask & POLLIN if self._console.unread else 0) | mask & POLLOUT
