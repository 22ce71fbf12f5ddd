"""``Pin``, ``PWM`` and ``ADC`` of a simulated board."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from pebble.extensions.lab.simulation.micropython.pins import PinName

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
