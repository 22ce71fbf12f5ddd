"""The hardware of a simulated board, as the firmware's modules and the tests reach it: pins, bus, console, timers."""

import random
from typing import Any, Final

from pebble.extensions.lab.simulation.micropython.clock import Clock
from pebble.extensions.lab.simulation.micropython.console import Console
from pebble.extensions.lab.simulation.micropython.faults import WouldHang
from pebble.extensions.lab.simulation.micropython.files import Files
from pebble.extensions.lab.simulation.micropython.i2c import Bus, Device
from pebble.extensions.lab.simulation.micropython.modules.timing import BoardTime
from pebble.extensions.lab.simulation.micropython.pins import Level, PinName, Pins, Volts
from pebble.extensions.lab.simulation.micropython.ports import SAMD21, Port
from pebble.extensions.lab.simulation.micropython.samd21 import PwmTimers
from pebble.extensions.lab.simulation.micropython.timers import SoftTimers, Watchdog

UID: Final = b"PBL\x00\x00\x01"


class Hardware:
    """A board without its firmware modules; all times come from ``clock``."""

    def __init__(
        self,
        clock: Clock,
        uid: bytes = UID,
        *,
        port: Port | None = None,
        ticks_at_boot_ms: int = 0,
        seed: int | None = None,
    ) -> None:
        self.clock, self.uid = clock, uid
        self.port = port or SAMD21
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

    def boot(self) -> None:
        """Power on or reset: no pin is an output, and the ticks restart."""
        self.pins.float_all()
        self.console.reset()
        self.watchdog.disarm()
        self.timers.clear()
        self.time.restart()
        self._pwm_timers = PwmTimers()

    def pause(self, seconds: float) -> None:
        """Block the firmware for ``seconds``; timers run, and the watchdog resets the board if it expires."""
        until = self.clock.now() + seconds
        while self.timers.running and (left := until - self.clock.now()) > 0.0:
            self.timers.wait(min(left, self.watchdog.left()))
            self.watchdog.check()
        self.clock.sleep(min(until - self.clock.now(), self.watchdog.left()))
        self.watchdog.check()
        self.console.interrupted()

    def _wait_for_input(self) -> None:
        """Wait while the firmware reads without input: only its timers run."""
        if not self.timers.running:
            raise WouldHang("the firmware waits for input while no timer is running")
        self.timers.wait(self.watchdog.left())
        self.watchdog.check()

    # -- from outside

    def duty(self, pin: PinName) -> float:
        """Return the output level of ``pin``, 0..1."""
        return self.pins.level(self.port.pin(pin))

    def set_volts(self, pin: PinName, volts: Volts) -> None:
        """Set the voltage at the ADC of ``pin``: a value, or a function that is called at each measurement."""
        self.pins.set_volts(self.port.pin(pin), volts)

    def set_pin(self, pin: PinName, high: Level) -> None:
        """Drive an input high or low, or by a function called at each read; None leaves it to its pull resistor."""
        self.pins.set_input(self.port.pin(pin), high)

    def attach_i2c(self, address: int, device: Device) -> None:
        self.bus.attach(address, device)

    def type(self, data: bytes) -> None:
        """Send data from the host to the board's serial port."""
        self.console.type(data)

    @property
    def unread(self) -> int:
        """Bytes from the host that the firmware has not read yet."""
        return self.console.unread

    def take_output(self) -> bytes:
        """Return the board's output on its serial port since the last call."""
        return self.console.take_output()

    def starved(self, now: float) -> bool:
        """Whether the watchdog would have reset the board by ``now``."""
        return self.watchdog.starved(now)

    # -- from the firmware

    def take_pwm(self, pin: PinName) -> None:
        """Assign a PWM channel to ``pin``."""
        if self.port.platform == SAMD21.platform:
            self._pwm_timers.take(str(pin))

    def free_pwm(self, pin: PinName) -> None:
        if self.port.platform == SAMD21.platform:
            self._pwm_timers.free(str(pin))

    def print(self, *values: object, sep: str = " ", end: str = "\n", file: Any = None) -> None:
        """The firmware's ``print``, which writes to the serial port or to ``file``."""
        text = sep.join(map(str, values)) + end
        if file is None:
            self.console.write(text.replace("\n", "\r\n").encode())
        else:
            file.write(text)
