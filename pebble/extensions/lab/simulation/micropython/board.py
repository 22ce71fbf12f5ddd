"""A simulated MicroPython board: the real firmware files on simulated pins, bus, console and clock."""

import array
import binascii
import collections
import errno
import hashlib
import io
import json
import math
import struct
from pathlib import Path
from typing import Any, Final, Protocol

from pebble.extensions.lab.simulation.micropython.clock import Clock
from pebble.extensions.lab.simulation.micropython.hardware import UID as UID
from pebble.extensions.lab.simulation.micropython.hardware import Hardware
from pebble.extensions.lab.simulation.micropython.loader import FirmwareModules
from pebble.extensions.lab.simulation.micropython.modules import machine, select, system
from pebble.extensions.lab.simulation.micropython.ports import OF_ROBOT, SAMD21, Port

SETTINGS_FILE: Final = "/private_config.json"

#: Modules of CPython: MicroPython's behave the same as far as our firmware uses them
_SHARED: Final = {
    "array": array,
    "binascii": binascii,
    "collections": collections,
    "errno": errno,
    "hashlib": hashlib,
    "io": io,
    "json": system.JSON,
    "math": math,
    "struct": struct,
}


class FirmwareRobot(Protocol):
    """The robot object that ``build`` of every firmware returns."""

    def step(self) -> None: ...

    def stop(self) -> None: ...


class Network(Protocol):
    """The radio of a board that has one; provides its modules at each boot."""

    def modules(self) -> dict[str, Any]:
        """Return ``network``, ``socket`` and ``ssl`` in the state after a boot."""


class Board(Hardware):
    """One board. ``load`` a robot's firmware, then call its ``step`` for each turn of its loop.

    ``clock`` may be shared with other boards. Ticks (period 2**30) start at ``ticks_at_boot_ms``. ``seed`` is that of
    the random numbers; default: derived from ``uid``. ``port`` is the board type; default: that of the loaded robot. A
    reset clears what the firmware did (outputs, modules, unread input), and nothing else; so ``files`` survive it,
    and a power cut. ``root`` is the folder with the firmware, if it is not Pebble's.
    """

    def __init__(
        self,
        clock: Clock,
        network: Network | None = None,
        uid: bytes = UID,
        *,
        port: Port | None = None,
        ticks_at_boot_ms: int = 0,
        seed: int | None = None,
        root: Path | None = None,
    ) -> None:
        super().__init__(clock, uid, port=port, ticks_at_boot_ms=ticks_at_boot_ms, seed=seed)
        self.network = network
        self._port_is_fixed = port is not None
        self._root = root
        self._firmware: FirmwareModules | None = None

    @property
    def firmware(self) -> FirmwareModules:
        """The modules of this boot, for example ``firmware.module("goob.pins")``."""
        if self._firmware is None:
            self._firmware = FirmwareModules(
                self._modules(), {"open": self.files.open, "print": self.print}, self._root
            )
        return self._firmware

    def load(self, robot: str, settings: dict[str, Any] | None = None) -> FirmwareRobot:
        """Boot, and build the ``robot`` of firmware/ with these ``settings`` (its private_config.json)."""
        self.configure_for(robot)
        self.boot()
        self.files[SETTINGS_FILE] = json.dumps(settings or {}).encode()
        built: FirmwareRobot = self.firmware.module(f"{robot}.robot").build(dict(settings or {}))
        return built

    def configure_for(self, robot: str) -> None:
        """Become the board type of ``robot``, which defines the names of pins, unless a type was given."""
        if not self._port_is_fixed:
            self.port = OF_ROBOT.get(robot, SAMD21)

    def boot(self) -> None:
        """Power on or reset: no pin is an output, no module is loaded, the ticks restart."""
        super().boot()
        self._firmware = None

    def _modules(self) -> dict[str, Any]:
        modules = {
            **_SHARED,
            "gc": system.GC,
            "machine": machine.Machine(self),
            "micropython": system.micropython_module(self),
            "os": system.os_module(self),
            "random": system.random_module(self),
            "select": select.module(self),
            "sys": system.sys_module(self),
            "time": self.time.module(),
            **(self.network.modules() if self.network is not None else {}),
        }
        return {name: module for name, module in modules.items() if name not in self.port.absent}
