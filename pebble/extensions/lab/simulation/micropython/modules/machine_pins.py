"""``Pin``, ``PWM`` and ``ADC`` of a simulated board."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from pebble.extensions.lab.simulation.micropython.pins import PinName

if TYPE_CHECKING:
    from pebble.extensions.lab.simulation.micropython.hardware import Hardware

_FULL_U16: Final = 65_535


class SimulatedPin:
    """``Pin(id, mode, pull, value=)``."""

    IN: Final = 0
    OUT: Final = 1
    OPEN_DRAIN: Final = 2
    PULL_UP: Final = 1
    PULL_DOWN: Final = 2
    _board: Hardware

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
        if value is not None or mode == self.IN:
            self._board.pins.put(self.name, float(bool(value)) if mode != self.IN else 0.0)

    def value(self, value: int | None = None) -> int | None:
        if value is not None:
            if self._mode != self.IN:
                self._board.pins.put(self.name, float(bool(value)))
            return None
        driven = self._board.pins.driven(self.name)
        if driven is None:
            high = self._pull == self.PULL_UP if self._mode == self.IN else self._board.pins.level(self.name) > 0.0
            return int(high)
        return int(driven)

    __call__ = value

    def on(self) -> None:
        self.value(1)

    def off(self) -> None:
        self.value(0)

    def __repr__(self) -> str:
        return f"Pin({self.name})"


def _name(board: Hardware, pin: SimulatedPin | PinName) -> PinName:
    return pin.name if isinstance(pin, SimulatedPin) else board.port.pin(pin)


class SimulatedPwm:
    """``PWM(pin, freq=, duty_u16=)``; there is no output before both are set."""

    _board: Hardware

    def __init__(self, dest: SimulatedPin | PinName, **settings: int) -> None:
        self._pin = _name(self._board, dest)
        self._freq, self._duty, self._shown = 0, 0, False
        self.init(**settings)

    def init(self, *, freq: int | None = None, duty_u16: int | None = None, duty: int | None = None) -> None:
        if freq is not None:
            self._freq = freq
        if duty is not None:
            duty_u16 = _of_1023(duty)
        if duty_u16 is not None:
            self._duty = duty_u16
        self._show()

    def freq(self, freq: int | None = None) -> int | None:
        if freq is None:
            return self._freq
        if freq <= 0:
            raise ValueError("freq must be positive")
        self.init(freq=freq)
        return None

    def duty_u16(self, duty: int | None = None) -> int | None:
        if duty is None:
            return self._duty
        if not 0 <= duty <= _FULL_U16:
            raise ValueError("duty_u16 must be 0..65535")
        self._duty = duty
        self._show()
        return None

    def duty(self, duty: int | None = None) -> int | None:
        """0..1023; not on SAMD."""
        if duty is None:
            return self._duty >> 6
        return self.duty_u16(_of_1023(duty))

    def deinit(self) -> None:
        """Make the pin an ordinary one, and low. Setting frequency or duty cycle restarts the signal."""
        self._board.pins.put(self._pin, 0.0)
        self._board.free_pwm(self._pin)
        self._shown = False

    def _show(self) -> None:
        if not self._shown:
            self._board.take_pwm(self._pin)
            self._shown = True
        if self._freq:
            self._board.pins.put(self._pin, self._duty / _FULL_U16)


def _of_1023(duty: int) -> int:
    return min(_FULL_U16, duty * _FULL_U16 // 1023)


class SimulatedAdc:
    """``ADC(pin)``; reads the voltage of ``Board.set_volts``."""

    ATTN_0DB: Final = 0
    ATTN_2_5DB: Final = 1
    ATTN_6DB: Final = 2
    ATTN_11DB: Final = 3
    WIDTH_12BIT: Final = 3
    _board: Hardware

    def __init__(self, pin: SimulatedPin | PinName, **_settings: int) -> None:
        self._pin = _name(self._board, pin)

    def read_u16(self) -> int:
        part = self._board.pins.volts(self._pin) / self._board.port.adc_v
        return max(0, min(_FULL_U16, round(part * _FULL_U16)))

    def read(self) -> int:
        """0..1023 on ESP8266, 0..4095 on ESP32."""
        return self.read_u16() >> (6 if self._board.port.platform == "esp8266" else 4)

    def read_uv(self) -> int:
        return round(self.read_u16() / _FULL_U16 * self._board.port.adc_v * 1_000_000)
