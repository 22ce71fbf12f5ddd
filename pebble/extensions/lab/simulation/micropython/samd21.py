"""The pins of the XIAO SAMD21: their names, and which of them can make a PWM signal.

The facts are from MicroPython's ports/samd: boards/SEEED_XIAO_SAMD21/pins.csv, mcu/samd21/pin-af-table.csv and
pin_af.c.
"""

from typing import Final

from pebble.extensions.lab.simulation.micropython.faults import SharedPwm

#: D0..D10, also called A0..A10 and A0_D0..A10_D10
_HEADER: Final = ("PA02", "PA04", "PA10", "PA11", "PA08", "PA09", "PB08", "PB09", "PA07", "PA05", "PA06")
_LEDS: Final = {"USER_LED": "PA17", "RX_LED": "PA18", "TX_LED": "PA19"}
_I2C_UART: Final = {"SCL": "PA09", "SDA": "PA08", "RX": "PB09", "TX": "PB08"}
_SPI: Final = {"MOSI": "PA06", "MISO": "PA05", "SCK": "PA07"}
_NAMES: Final = {
    **{
        name: pin for number, pin in enumerate(_HEADER) for name in (f"D{number}", f"A{number}", f"A{number}_D{number}")
    },
    **{pin: pin for pin in _HEADER},
    **{pin: pin for pin in _LEDS.values()},
    **_LEDS,
    **_I2C_UART,
    **_SPI,
}

#: (timer TCCn, output) in the order in which MicroPython tries them; other pins have no PWM
_TIMERS: Final = {
    "PA04": ((0, 0),),
    "PA05": ((0, 1),),
    "PA06": ((1, 0),),
    "PA07": ((1, 1),),
    "PA08": ((0, 0), (1, 2)),
    "PA09": ((0, 1), (1, 3)),
    "PA10": ((1, 0), (0, 2)),
    "PA11": ((1, 1), (0, 3)),
    "PA17": ((2, 1), (0, 7)),
    "PA18": ((0, 2),),
    "PA19": ((0, 3),),
}
_CHANNELS: Final = (4, 2, 2)  # of TCC0, TCC1, TCC2; output n has channel n modulo this


def pin(name: str) -> str:
    """Return the MCU's name of a pin (``PA02``). Raises ValueError with MicroPython's message if there is none."""
    if name not in _NAMES:
        raise ValueError(f"not a Pin: {name!r}")
    return _NAMES[name]


class PwmTimers:
    """The assignment of the timers' PWM channels to pins."""

    def __init__(self) -> None:
        self._started: set[int] = set()  # a timer stays started when its last signal ends
        self._pin_of: dict[tuple[int, int], str] = {}  # by timer and channel
        self._channel_of: dict[str, tuple[int, int]] = {}  # by pin: timer and channel

    def take(self, pin: str) -> None:
        """Assign the channel that MicroPython assigns: that of a timer not yet started, else of the first timer."""
        if pin in self._channel_of:
            return
        possible = _TIMERS.get(pin, ())
        if not possible:
            raise ValueError(f"not a PWM Pin: {pin}")
        unused = [(timer, output) for timer, output in possible if timer not in self._started]
        timer, output = unused[0] if unused else possible[0]
        channel = timer, output % _CHANNELS[timer]
        if channel in self._pin_of:
            raise SharedPwm(f"{pin} and {self._pin_of[channel]} are both on channel {channel[1]} of TCC{timer}")
        self._started.add(timer)
        self._pin_of[channel], self._channel_of[pin] = pin, channel

    def free(self, pin: str) -> None:
        if pin in self._channel_of:
            del self._pin_of[self._channel_of.pop(pin)]
