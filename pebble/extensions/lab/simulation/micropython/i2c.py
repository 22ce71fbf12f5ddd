"""A simulated I2C bus, whose devices answer, are absent, or fail."""

import errno
from typing import Protocol

from pebble.extensions.lab.simulation.micropython.faults import failure


class Device(Protocol):
    """A device on the bus. Both methods may raise OSError if it does not acknowledge."""

    def write(self, data: bytes) -> None:
        """Handle ``data``, which follows the address."""

    def read(self, count: int) -> bytes:
        """Return exactly ``count`` bytes."""


class Bus:
    """A bus of a board. ``fail`` makes a device stop acknowledging until ``restore``."""

    def __init__(self) -> None:
        self._devices: dict[int, Device] = {}
        self._failing: set[int] = set()

    def attach(self, address: int, device: Device) -> None:
        self._devices[address] = device

    def fail(self, address: int) -> None:
        """Make every later transfer with ``address`` raise OSError (EIO)."""
        self._failing.add(address)

    def restore(self, address: int) -> None:
        self._failing.discard(address)

    def device(self, address: int) -> Device:
        """Return the device at ``address``. Raises OSError: ENODEV if there is none."""
        if address in self._failing:
            raise failure(errno.EIO)
        if address not in self._devices:
            raise failure(errno.ENODEV)
        return self._devices[address]
