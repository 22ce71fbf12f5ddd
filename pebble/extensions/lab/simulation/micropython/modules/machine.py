"""The ``machine`` module of a simulated board: timers, clock, watchdog, I2C and UART; pins are in machine_pins.py."""

from __future__ import annotations

import errno
from collections.abc import Callable
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Final

from pebble.extensions.lab.simulation.micropython.faults import failure
from pebble.extensions.lab.simulation.micropython.i2c import Bus, Device
from pebble.extensions.lab.simulation.micropython.modules.machine_pins import SimulatedAdc, SimulatedPin, SimulatedPwm
from pebble.extensions.lab.simulation.micropython.modules.streams import POLLIN, POLLOUT
from pebble.extensions.lab.simulation.micropython.timers import BoardReset

if TYPE_CHECKING:
    from pebble.extensions.lab.simulation.micropython.hardware import Hardware


class SimulatedTimer:
    """``Timer(-1, period=ms, callback=)``: called while the program sleeps, or waits for input."""

    ONE_SHOT: Final = 0
    PERIODIC: Final = 1
    _board: Hardware

    def __init__(self, _number: int = -1, **settings: Any) -> None:
        self.period_s, self.repeats = 0.0, True
        self.callback: Callable[[Any], None] = lambda _timer: None
        if settings:
            self.init(**settings)

    def init(self, *, period: int = -1, mode: int = PERIODIC, callback: Callable[[Any], None] | None = None) -> None:
        if period <= 0:
            raise ValueError("a Timer needs a period")
        self.period_s, self.repeats = period / 1000, mode == self.PERIODIC
        self.callback = callback or self.callback
        self._board.timers.start(self)

    def deinit(self) -> None:
        self._board.timers.stop(self)


class SimulatedRtc:
    """``RTC().datetime((year, month, day, weekday, hours, minutes, seconds, microseconds))``, and without it."""

    _board: Hardware

    def datetime(self, value: tuple[int, ...] | None = None) -> tuple[int, ...] | None:
        if value is not None:
            self._board.rtc = value
            return None
        return self._board.rtc


class SimulatedWdt:
    """``WDT(timeout=ms)``: once made, it cannot be stopped, only fed."""

    _board: Hardware

    def __init__(self, number: int = 0, timeout: int = 5000) -> None:
        if number != 0:
            raise ValueError(f"WDT({number}) does not exist")
        self._board.watchdog.arm(self._board.port.wdt_ms(timeout))

    def feed(self) -> None:
        self._board.watchdog.feed()


class SimulatedI2c:
    """``I2C``, ``SoftI2C``: transfers with devices on the board's bus; OSError ENODEV if there is none."""

    _board: Hardware

    def __init__(self, *_id: int, scl: Any = None, sda: Any = None, freq: int = 400_000, timeout: int = 50_000) -> None:
        del scl, sda, freq, timeout
        self._bus: Bus = self._board.bus

    def init(self, **settings: Any) -> None:
        """Ignored: it has no visible effect."""

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
    """``UART``: connected to the host, as USB is."""

    _board: Hardware

    def __init__(self, _number: int, baudrate: int = 9600, **_settings: Any) -> None:
        self.baudrate = baudrate
        self._board.console.interrupt = -1  # Ctrl-C is for USB
        self._console = self._board.console

    def any(self) -> int:
        return self._console.unread

    def read(self, count: int = -1) -> bytes | None:
        """Return available bytes, at most ``count``; None if there are none."""
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


_KINDS: Final[dict[str, type]] = {
    "Pin": SimulatedPin,
    "PWM": SimulatedPwm,
    "ADC": SimulatedAdc,
    "I2C": SimulatedI2c,
    "SoftI2C": SimulatedI2c,
    "Timer": SimulatedTimer,
    "UART": SimulatedUart,
    "RTC": SimulatedRtc,
    "WDT": SimulatedWdt,
}


class Machine(SimpleNamespace):
    """The module. Its classes belong to this board and are made at first use, because a class takes 3 KB."""

    def __init__(self, board: Hardware) -> None:
        super().__init__(
            unique_id=lambda: board.uid,
            reset=_reset,
            freq=lambda *_hertz: board.port.hertz,
            idle=lambda: None,
            disable_irq=lambda: 0,
            enable_irq=lambda _state: None,
        )
        self._board = board

    def __getattr__(self, name: str) -> type:
        if name not in _KINDS:
            raise AttributeError(f"module 'machine' has no attribute '{name}'")
        own = type(name, (_KINDS[name],), {"_board": self._board})
        setattr(self, name, own)
        return own


def _reset() -> None:
    raise BoardReset("machine.reset()")
