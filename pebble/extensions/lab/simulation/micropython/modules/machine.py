"""The ``machine`` module of a simulated board: pins, timers, clock, watchdog, I2C and UART."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Final

from pebble.extensions.lab.simulation.micropython.i2c import Bus
from pebble.extensions.lab.simulation.micropython.pins import PinName
from pebble.extensions.lab.simulation.micropython.timers import BoardReset

if TYPE_CHECKING:
    from pebble.extensions.lab.simulation.micropython.board import Board


_FULL_U16: Final = 65_535


class SimulatedPin:
    """``Pin(id, mode, pull, value=)``."""

    IN: Final = 0
    OUT: Final = 1
    PULL_UP: Final = 1
    PULL_DOWN: Final = 2
    _board: Board

    def __init__(
        self,
        name: PinName | SimulatedPin,
        mode: int | None = None,
        pull: int | None = None,
        *,
        value: int | None = None,
    ) -> None:
        self.name = _name(self._board, name)
        self._mode, self._pull = self.IN, pull
        if mode is not None:
            self.init(mode, pull, value=value)

    def init(self, mode: int = IN, pull: int | None = None, *, value: int | None = None) -> None:
        self._mode, self._pull = mode, pull
        if mode == self.IN:
            self._board.pins.put(self.name, 0.0)
        elif value is not None:
            self._board.pins.put(self.name, float(bool(value)))

    def value(self, value: int | None = None) -> int | None:
        """Set the level of an output; without ``value`` return the level of the pin."""
        if value is not None:
            if self._mode != self.IN:
                self._board.pins.put(self.name, float(bool(value)))
            return None
        driven = self._board.pins.driven(self.name)  # from outside
        if driven is not None:
            return int(driven)
        if self._mode == self.IN:
            return int(self._pull == self.PULL_UP)
        return int(self._board.pins.level(self.name) > 0.0)


def _name(board: Board, pin: SimulatedPin | PinName) -> PinName:
    return pin.name if isinstance(pin, SimulatedPin) else board.port.pin(pin)


class SimulatedPwm:
    """``PWM(pin, freq=, duty_u16=)``."""

    _board: Board

    def __init__(self, dest: SimulatedPin | PinName, *, freq: int, duty_u16: int = 0) -> None:
        if freq <= 0:
            raise ValueError("freq must be positive")
        self._pin, self._has_channel = _name(self._board, dest), False
        self.duty_u16(duty_u16)

    def duty_u16(self, duty: int) -> None:
        if not 0 <= duty <= _FULL_U16:
            raise ValueError("duty_u16 must be 0..65535")
        if not self._has_channel:
            self._board.take_pwm(self._pin)
            self._has_channel = True
        self._board.pins.put(self._pin, duty / _FULL_U16)

    def deinit(self) -> None:
        """Make the pin an ordinary one, and low. Setting the duty cycle restarts the signal."""
        self._board.pins.put(self._pin, 0.0)
        self._board.free_pwm(self._pin)
        self._has_channel = False


class SimulatedAdc:
    """``ADC(pin)``; reads the voltage of ``Board.set_volts``."""

    ATTN_11DB: Final = 3
    _board: Board

    def __init__(self, pin: SimulatedPin | PinName, **_settings: int) -> None:
        self._pin = _name(self._board, pin)

    def read_u16(self) -> int:
        part = self._board.pins.volts(self._pin) / self._board.port.adc_v
        return max(0, min(_FULL_U16, round(part * _FULL_U16)))


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
        return len(self._console.typed)

    def readinto(self, buffer: bytearray | memoryview) -> int | None:
        """Read the available bytes into ``buffer``; return their number, None if there are none."""
        data = self._console.take(min(len(buffer), self.any()))
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
