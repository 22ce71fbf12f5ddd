"""The ``machine`` module of a simulated board: timers, clock, watchdog, I2C and UART; pins are in machine_pins.py."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Final

from pebble.extensions.lab.simulation.micropython.i2c import Bus
from pebble.extensions.lab.simulation.micropython.modules.machine_pins import SimulatedAdc, SimulatedPin, SimulatedPwm
from pebble.extensions.lab.simulation.micropython.timers import BoardReset

if TYPE_CHECKING:
    from pebble.extensions.lab.simulation.micropython.board import Board


class SimulatedTimer:
    """``Timer(-1, period=ms, callback=)``: calls the function periodically while the program sleeps, or waits."""

    _board: Board

    def __init__(self, _number: int = -1, *, period: int, callback: Callable[[Any], None]) -> None:
        self.period_s, self.callback = period / 1000, callback
        self._board.timers.start(self)


class SimulatedRtc:
    """``RTC().datetime((year, month, day, weekday, hours, minutes, seconds, microseconds))``."""

    _board: Board

    def datetime(self, value: tuple[int, ...]) -> None:
        self._board.rtc = value


class SimulatedWdt:
    """``WDT(timeout=ms)``: once made, it cannot be stopped, only fed."""

    _board: Board

    def __init__(self, _number: int = 0, timeout: int = 5000) -> None:
        self._board.watchdog.arm(self._board.port.wdt_ms(timeout))

    def feed(self) -> None:
        self._board.watchdog.feed()


class SimulatedI2c:
    """``SoftI2C``: transfers with devices on the board's bus; OSError ENODEV if there is none."""

    _board: Board

    def __init__(self, *_id: int, scl: Any = None, sda: Any = None, freq: int = 400_000, timeout: int = 50_000) -> None:
        del scl, sda, freq, timeout
        self._bus: Bus = self._board.bus

    def writeto(self, addr: int, buf: bytes) -> int:
        self._bus.device(addr).write(bytes(buf))
        return len(buf)

    def writeto_mem(self, addr: int, memaddr: int, buf: bytes) -> None:
        self._bus.device(addr).write(bytes([memaddr]) + bytes(buf))

    def readfrom_mem(self, addr: int, memaddr: int, nbytes: int) -> bytes:
        device = self._bus.device(addr)
        device.write(bytes([memaddr]))
        return device.read(nbytes)

    def readfrom_mem_into(self, addr: int, memaddr: int, buf: bytearray) -> None:
        buf[:] = self.readfrom_mem(addr, memaddr, len(buf))


class SimulatedUart:
    """``UART``: connected to the host, as USB is."""

    _board: Board

    def __init__(self, _number: int, baudrate: int = 9600, **_settings: Any) -> None:
        self.baudrate = baudrate
        self._board.console.interrupt = -1  # Ctrl-C is for USB
        self._console = self._board.console

    def any(self) -> int:
        return self._console.unread

    def readinto(self, buffer: bytearray | memoryview) -> int | None:
        """Read the available bytes into ``buffer``; return their number, None if there are none."""
        data = self._console.take(min(len(buffer), self._console.unread))
        buffer[: len(data)] = data
        return len(data) or None

    def write(self, data: Any, start: int, length: int) -> int | None:
        """Write to the host; return how many bytes were accepted, None if none."""
        return self._console.write(data[start : start + length]) or None


_KINDS: Final[dict[str, type]] = {
    "Pin": SimulatedPin,
    "PWM": SimulatedPwm,
    "ADC": SimulatedAdc,
    "SoftI2C": SimulatedI2c,
    "Timer": SimulatedTimer,
    "UART": SimulatedUart,
    "RTC": SimulatedRtc,
    "WDT": SimulatedWdt,
}


class Machine(SimpleNamespace):
    """The module ``machine``. Its classes belong to this board, and are made at first use: a class takes 3 KB."""

    def __init__(self, board: Board) -> None:
        super().__init__(reset=_reset)
        self._board = board

    def __getattr__(self, name: str) -> type:
        if name not in _KINDS:
            raise AttributeError(f"module 'machine' has no attribute '{name}'")
        kind = type(name, (_KINDS[name],), {"_board": self._board})
        setattr(self, name, kind)
        return kind


def _reset() -> None:
    raise BoardReset("machine.reset()")
