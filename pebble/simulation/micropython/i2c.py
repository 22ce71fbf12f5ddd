"""A simulated I2C bus: devices that answer, are absent, or fail."""

from __future__ import annotations

import errno
from typing import Protocol

from pebble.simulation.micropython.faults import failure


class Device(Protocol):
    """What hangs on the bus. Both may raise OSError, as a device that does not acknowledge does."""

    def write(self, data: bytes) -> None:
        """Take ``data``, which followed the address."""

    def read(self, count: int) -> bytes:
        """Give exactly ``count`` bytes."""


class Bus:
    """One bus of a board; ``fail(address)`` makes a device stop acknowledging until ``mend``, ``disturbed`` all."""

    def __init__(self) -> None:
        self.disturbed = False
        self._devices: dict[int, Device] = {}
        self._failing: dict[int, int] = {}

    def attach(self, address: int, device: Device) -> None:
        self._devices[address] = device

    def detach(self, address: int) -> None:
        self._devices.pop(address, None)

    def fail(self, address: int, code: int = errno.EIO) -> None:
        """From now on every transfer with ``address`` is an OSError ``code`` (EIO, ETIMEDOUT, …)."""
        self._failing[address] = code

    def mend(self, address: int) -> None:
        self._failing.pop(address, None)

    def addresses(self) -> list[int]:
        return [] if self.disturbed else sorted(self._devices.keys() - self._failing.keys())

    def device(self, address: int) -> Device:
        """The device that acknowledges ``address``; OSError ENODEV if none does."""
        if self.disturbed:
            raise failure(errno.EIO)
        if address in self._failing:
            raise failure(self._failing[address])
        if address not in self._devices:
            raise failure(errno.ENODEV)
        return self._devices[address]
