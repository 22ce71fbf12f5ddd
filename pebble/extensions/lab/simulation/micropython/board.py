"""A simulated MicroPython board: the real firmware files on simulated pins, bus, console and clock."""

import binascii
import errno
import hashlib
import json
import math
import random
import struct
from typing import Any, Final, Protocol

from pebble.extensions.lab.simulation.micropython.clock import Clock
from pebble.extensions.lab.simulation.micropython.console import Console
from pebble.extensions.lab.simulation.micropython.faults import WouldHang
from pebble.extensions.lab.simulation.micropython.files import Files
from pebble.extensions.lab.simulation.micropython.i2c import Bus
from pebble.extensions.lab.simulation.micropython.loader import FirmwareModules
from pebble.extensions.lab.simulation.micropython.modules import machine, system
from pebble.extensions.lab.simulation.micropython.modules.streams import select_module
from pebble.extensions.lab.simulation.micropython.modules.timing import BoardTime
from pebble.extensions.lab.simulation.micropython.pins import Level, PinName, Pins, Volts
from pebble.extensions.lab.simulation.micropython.ports import OF_ROBOT, SAMD21, Port
from pebble.extensions.lab.simulation.micropython.samd21 import PwmTimers
from pebble.extensions.lab.simulation.micropython.timers import SoftTimers, Watchdog

SETTINGS_FILE: Final = "/private_config.json"
UID: Final = b"PBL\x00\x00\x01"

#: Modules of CPython: MicroPython's behave the same as far as our firmware uses them
_SHARED: Final = {
    "binascii": binascii,
    "errno": errno,
    "hashlib": hashlib,
    "json": system.JSON,
    "math": math,
    "struct": struct,
}


class FirmwareRobot(Protocol):
    """The robot object that ``build`` of every firmware returns."""

    def step(self) -> None: ...

    def stop(self) -> None: ...


class Network(Protocol):
    """The radio of a board that has one. It provides the board's network modules at each boot."""

    def modules(self) -> dict[str, Any]:
        """Return ``network``, ``socket`` and ``ssl`` in their state after a boot."""


class Board:
    """A board. ``load`` a robot's firmware, then call its ``step`` for each turn of its loop.

    All times come from ``clock``, which boards may share. Ticks (period 2**30) start at ``ticks_at_boot_ms``. ``seed``
    is for random numbers; by default it is derived from ``uid``. ``port`` is the board type; by default that of the
    loaded robot. A reset clears what the firmware did (outputs, modules, unread input) and nothing else: ``files``
    survive it, and a power cut.
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
    ) -> None:
        self.clock, self.network, self.uid = clock, network, uid
        self.port, self._port_is_fixed = port or SAMD21, port is not None
        self.pins = Pins()
        self.bus = Bus()
        self.console = Console(self.pause, self._wait_for_input)
        self.timers = SoftTimers(clock)
        self.time = BoardTime(clock, self.pause, ticks_at_boot_ms)
        self.watchdog = Watchdog(clock)
        self.random = random.Random(int.from_bytes(uid, "big") if seed is None else seed)  # noqa: S311 - repeatable
        self.files = Files()
        self.resets = 0
        self.rtc: tuple[int, ...] = (2000, 1, 1, 5, 0, 0, 0, 0)  # as after power on
        self._pwm_timers = PwmTimers()
        self._firmware: FirmwareModules | None = None

    @property
    def firmware(self) -> FirmwareModules:
        """Modules of this boot, for example ``firmware.module("goob.pins")``."""
        if self._firmware is None:
            self._firmware = FirmwareModules(self._modules(), {"open": self.files.open, "print": self.print})
        return self._firmware

    def load(self, robot: str, settings: dict[str, Any] | None = None) -> FirmwareRobot:
        """Boot with the firmware of ``robot`` and its ``settings`` (private_config.json); return its robot object."""
        self.configure_for(robot)
        self.boot()
        self.files[SETTINGS_FILE] = json.dumps(settings or {}).encode()
        built: FirmwareRobot = self.firmware.module(f"{robot}.robot").build(dict(settings or {}))
        return built

    def configure_for(self, robot: str) -> None:
        """Use the board type of ``robot``, which defines the names of pins, unless a type was given."""
        if not self._port_is_fixed:
            self.port = OF_ROBOT.get(robot, SAMD21)

    def boot(self) -> None:
        """Power on or reset: no pin is an output, no module is loaded, the ticks restart."""
        self.pins.float_all()
        self.console.reset()
        self.watchdog.disarm()
        self.timers.clear()
        self.time.restart()
        self._pwm_timers = PwmTimers()
        self._firmware = None

    def pause(self, seconds: float) -> None:
        """Block the firmware for ``seconds``; timers run, and the watchdog resets the board if it expires."""
        until = self.clock.now() + seconds
        while self.timers.running and (remaining_s := until - self.clock.now()) > 0.0:
            self.timers.wait(min(remaining_s, self.watchdog.left()))
            self.watchdog.check()
        self.clock.sleep(min(until - self.clock.now(), self.watchdog.left()))
        self.watchdog.check()
        self.console.check_interrupt()

    def _wait_for_input(self) -> None:
        """Wait while the firmware reads and there is no input: only its timers run."""
        if not self.timers.running:
            raise WouldHang("the firmware waits for input while no timer is running")
        self.timers.wait(self.watchdog.left())
        self.watchdog.check()

    def _modules(self) -> dict[str, Any]:
        """Return MicroPython's own modules by name, as far as a board of this type has them."""
        modules = {
            **_SHARED,
            "gc": system.GC,
            "machine": machine.Machine(self),
            "micropython": system.micropython_module(self),
            "os": system.os_module(self),
            "random": system.random_module(self),
            "select": select_module(),
            "sys": system.sys_module(self),
            "time": self.time.module(),
            **(self.network.modules() if self.network is not None else {}),
        }
        return {name: module for name, module in modules.items() if name not in self.port.absent}

    # -- from outside

    def duty(self, pin: PinName) -> float:
        """Return the output level of ``pin``, 0..1."""
        return self.pins.level(self.port.pin(pin))

    def set_volts(self, pin: PinName, volts: Volts) -> None:
        """Set the voltage at the ADC of ``pin``: a number, or a function that is called at each measurement."""
        self.pins.set_volts(self.port.pin(pin), volts)

    def set_pin(self, pin: PinName, high: Level) -> None:
        """Drive an input high or low, or by a function called at each read; None leaves it to its pull resistor."""
        self.pins.set_input(self.port.pin(pin), high)

    # -- from the firmware

    def take_pwm(self, pin: PinName) -> None:
        """Assign a PWM channel to ``pin``."""
        if self.port.platform == SAMD21.platform:
            self._pwm_timers.take(str(pin))

    def free_pwm(self, pin: PinName) -> None:
        if self.port.platform == SAMD21.platform:
            self._pwm_timers.free(str(pin))

    def print(self, *values: object, sep: str = " ", end: str = "\n", file: Any = None) -> None:
        """Print as MicroPython does, to the serial port or to ``file``."""
        text = sep.join(map(str, values)) + end
        if file is None:
            self.console.write(text.replace("\n", "\r\n").encode())
        else:
            file.write(text)
