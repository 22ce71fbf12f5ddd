"""The ``machine`` module of a simulated board."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Final

from pebble.simulation.micropython.machine_lines import SimulatedI2c, SimulatedUart
from pebble.simulation.micropython.machine_pins import SimulatedAdc, SimulatedPin, SimulatedPwm
from pebble.simulation.micropython.watchdog import BoardReset

if TYPE_CHECKING:
    from pebble.simulation.micropython.board import Board


class SimulatedTimer:
    """``Timer(-1, period=ms, callback=)``: called while the program sleeps, or waits for input."""

    ONE_SHOT: Final = 0
    PERIODIC: Final = 1
    _board: Board

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

    _board: Board

    def datetime(self, value: tuple[int, ...] | None = None) -> tuple[int, ...] | None:
        if value is not None:
            self._board.rtc = value
            return None
        return self._board.rtc


class SimulatedWdt:
    """``WDT(timeout=ms)``: once made it cannot be stopped, only fed."""

    _board: Board

    def __init__(self, number: int = 0, timeout: int = 5000) -> None:
        if number != 0:
            raise ValueError(f"WDT({number}) does not exist")
        self._board.watchdog.arm(self._board.port.wdt_ms(timeout))

    def feed(self) -> None:
        self._board.watchdog.feed()


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
    """The module. Its classes are this board's own, made when they are asked for: a class takes 3 KB."""

    def __init__(self, board: Board) -> None:
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
