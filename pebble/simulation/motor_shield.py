"""A simulated WEMOS D1 mini motor shield v1.0.0: an I2C device with two motor outputs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

_MESSAGE = 4  # bytes; the shield takes nothing else
_FULL: Final = 10_000  # duty cycle in 1/100 %
_SIGN: Final = {1: -1.0, 2: 1.0}  # counter-clockwise, clockwise; brake, stop and standby do not turn


class MotorShield:
    """``speeds`` of motors A and B, −1..1, + = clockwise. It goes on by itself when its master dies.

    Nothing turns before the PWM frequency was set. ``before_change`` is called just before a message is obeyed.
    """

    def __init__(self) -> None:
        self.before_change: Callable[[], None] = lambda: None
        self.frequency_hz = 0
        self._told = [0.0, 0.0]

    @property
    def speeds(self) -> tuple[float, float]:
        return (self._told[0], self._told[1]) if self.frequency_hz else (0.0, 0.0)

    def write(self, data: bytes) -> None:
        if len(data) != _MESSAGE:
            return
        self.before_change()
        if data[0] & 0xF0 == 0x10:
            duty = min(_FULL, int.from_bytes(data[2:], "big")) / _FULL
            self._told[data[0] & 1] = _SIGN.get(data[1], 0.0) * duty
        elif data[0] == 0:
            self.frequency_hz = int.from_bytes(data[1:], "big")

    def read(self, count: int) -> bytes:
        return bytes(count)
