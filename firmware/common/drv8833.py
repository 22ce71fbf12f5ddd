"""One motor on half of a DRV8833: PWM on one input, the other low; both low lets it coast (TI SLVSAR1, table 1).

A driver, shared by all robots with this chip.
"""

from machine import PWM, Pin


class Motor:
    """A motor on ``pins`` = (in1, in2). It is off from the moment it exists."""

    def __init__(self, pins: tuple[int | str, int | str], freq_hz: int = 1000) -> None:
        self._ahead, self._back = [PWM(Pin(pin, Pin.OUT, value=0), freq=freq_hz, duty_u16=0) for pin in pins]
        self._duty = 0

    def set(self, speed: float) -> None:
        """Turn at ``speed``, -1..1; + drives in1."""
        duty = int(speed * 65535)
        if duty == self._duty:
            return
        self._duty = duty
        # the input that goes low is set first: both high would brake
        if duty > 0:
            self._back.duty_u16(0)
            self._ahead.duty_u16(duty)
        else:
            self._ahead.duty_u16(0)
            self._back.duty_u16(-duty)

    def stop(self) -> None:
        self._duty = 0
        self._ahead.duty_u16(0)
        self._back.duty_u16(0)
