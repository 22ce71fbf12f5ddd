"""A simulated MicroPython board: the real firmware files on pins, a bus, a console and a clock that are not real."""

from __future__ import annotations

import array
import binascii
import collections
import errno
import hashlib
import io
import json
import math
import random
import struct
from pathlib import Path
from typing import Any, Final, Protocol

from pebble.simulation.micropython import machine, select, strict_json, system
from pebble.simulation.micropython.clock import Clock
from pebble.simulation.micropython.console import Console
from pebble.simulation.micropython.faults import WouldHang, failure
from pebble.simulation.micropython.i2c import Bus, Device
from pebble.simulation.micropython.loader import Firmware
from pebble.simulation.micropython.pins import Level, PinName, Pins, Volts
from pebble.simulation.micropython.ports import OF_ROBOT, SAMD21, Port
from pebble.simulation.micropython.samd21 import Timers
from pebble.simulation.micropython.timers import SoftTimers
from pebble.simulation.micropython.timing import BoardTime
from pebble.simulation.micropython.watchdog import Watchdog

UID: Final = b"PBL\x00\x00\x01"
SETTINGS_FILE: Final = "/private_config.json"

#: Modules that are CPython's own, because MicroPython's behave the same where our firmware uses them
_SHARED: Final = {
    "array": array,
    "binascii": binascii,
    "collections": collections,
    "errno": errno,
    "hashlib": hashlib,
    "io": io,
    "json": strict_json.MODULE,
    "math": math,
    "struct": struct,
}


class Robot(Protocol):
    """What ``build`` of every firmware returns."""

    def step(self) -> None: ...

    def stop(self) -> None: ...


class Network(Protocol):
    """The radio of a board, if it has one. Asked for its modules at each boot."""

    def modules(self) -> dict[str, Any]:
        """``network``, ``socket`` and ``ssl`` as a board that just booted finds them."""


class Board:
    """One board. ``load`` a robot's firmware, then ``step`` it as often as its loop would turn.

    ``clock`` is all boards' or this one's; ``ticks_at_boot_ms`` is where its ticks (period 2**30) start, and ``seed``
    decides its random numbers (default: its ``uid`` does). ``port`` is what kind of board it is; without it, the one
    that the loaded robot has. Everything here survives a reset except what the firmware did: outputs, modules, unread
    input. ``root`` is the folder with the firmware, if it is not Pebble's.
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
        self.clock, self.uid, self.network = clock, uid, network
        self.port = port or SAMD21
        self.pins = Pins()
        self.bus = Bus()
        self.console = Console(self.pause, self._wait_for_input)
        self.timers = SoftTimers(clock)
        self.time = BoardTime(clock, self.pause, ticks_at_boot_ms)
        self.watchdog = Watchdog(clock)
        self.random = random.Random(int.from_bytes(uid, "big") if seed is None else seed)  # noqa: S311 - repeatable
        self.files: dict[str, bytes] = {}
        self.resets = 0
        self.rtc: tuple[int, ...] = (2000, 1, 1, 5, 0, 0, 0, 0)  # as after power on
        self._port_is_fixed = port is not None
        self._root = root
        self._pwm_timers = Timers()
        self._firmware: Firmware | None = None

    @property
    def firmware(self) -> Firmware:
        """The import world of this boot: ``firmware.module("goob.pins")``."""
        if self._firmware is None:
            self._firmware = Firmware(self._modules(), {"open": self.open, "print": self.print}, self._root)
        return self._firmware

    def load(self, robot: str, settings: dict[str, Any] | None = None) -> Robot:
        """Boot, and build the ``robot`` of firmware/ with these ``settings`` (its private_config.json)."""
        self.shape_for(robot)
        self.boot()
        self.files[SETTINGS_FILE] = json.dumps(settings or {}).encode()
        built: Robot = self.firmware.module(f"{robot}.robot").build(dict(settings or {}))
        return built

    def shape_for(self, robot: str) -> None:
        """Be the kind of board that ``robot`` has, unless the kind was given: pins get their names by it."""
        if not self._port_is_fixed:
            self.port = OF_ROBOT.get(robot, SAMD21)

    def boot(self) -> None:
        """Power on or reset: no pin is an output, nothing is loaded, the ticks start anew."""
        self.pins.float_all()
        self.console.reset()
        self.watchdog.disarm()
        self.timers.clear()
        self.time.restart()
        self._pwm_timers = Timers()
        self._firmware = None

    def pause(self, seconds: float) -> None:
        """Something blocks the firmware for ``seconds``; a watchdog that starves meanwhile resets the board."""
        until = self.clock.now() + seconds
        while self.timers.running and (left := until - self.clock.now()) > 0.0:
            self.timers.wait(min(left, self.watchdog.left()))
            self.watchdog.check()
        self.clock.sleep(min(until - self.clock.now(), self.watchdog.left()))
        self.watchdog.check()
        self.console.interrupted()

    def _wait_for_input(self) -> None:
        """The firmware reads, and there is nothing: its timers go on meanwhile."""
        if not self.timers.running:
            raise WouldHang("the firmware waits for input, and nothing else goes on meanwhile")
        self.timers.wait(self.watchdog.left())
        self.watchdog.check()

    # -- from outside

    def duty(self, pin: PinName) -> float:
        """What the firmware puts out on ``pin``: 0..1."""
        return self.pins.level(self.port.pin(pin))

    def set_volts(self, pin: PinName, volts: Volts) -> None:
        """What the ADC of ``pin`` measures from now on: a voltage, or a function that says it when it is asked."""
        self.pins.set_volts(self.port.pin(pin), volts)

    def set_pin(self, pin: PinName, high: Level) -> None:
        """Pull an input high or low, or as a function says when it is asked; None leaves it to its pull resistor."""
        self.pins.set_input(self.port.pin(pin), high)

    def attach_i2c(self, address: int, device: Device) -> None:
        self.bus.attach(address, device)

    def type(self, data: bytes) -> None:
        """The host writes to the board's serial port."""
        self.console.type(data)

    @property
    def unread(self) -> int:
        """Bytes from the host that the firmware has not read yet."""
        return self.console.unread

    def said(self) -> bytes:
        """What the board wrote to its serial port since the last call."""
        return self.console.said()

    def starved(self, now: float) -> bool:
        """Whether the watchdog would have reset the board by ``now``."""
        return self.watchdog.starved(now)

    # -- from the firmware

    def take_pwm(self, pin: PinName) -> None:
        """The firmware wants a PWM signal on ``pin``."""
        if self.port.platform == SAMD21.platform:
            self._pwm_timers.take(str(pin))

    def free_pwm(self, pin: PinName) -> None:
        if self.port.platform == SAMD21.platform:
            self._pwm_timers.free(str(pin))

    def print(self, *values: object, sep: str = " ", end: str = "\n", file: Any = None) -> None:
        """The firmware's ``print``: it writes into the same serial port as everything else."""
        text = sep.join(map(str, values)) + end
        if file is None:
            self.console.write(text.replace("\n", "\r\n").encode())
        else:
            file.write(text)

    def open(self, path: str, mode: str = "r") -> io.BytesIO | io.StringIO:
        """The firmware's ``open``, for reading what is in ``files``."""
        if "r" not in mode or "+" in mode:
            raise failure(errno.EROFS)
        if path not in self.files:
            raise failure(errno.ENOENT)
        return io.BytesIO(self.files[path]) if "b" in mode else io.StringIO(self.files[path].decode())

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
