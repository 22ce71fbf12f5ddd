"""The pins of a simulated board, seen from outside: the firmware's outputs, and levels and voltages at inputs."""

from collections.abc import Callable

PinName = str | int
Volts = float | Callable[[], float]
Level = bool | Callable[[], bool] | None


class Pins:
    """The levels of outputs (0..1: the duty cycle for PWM), and the volts and levels at inputs.

    ``before_change`` is called just before an output changes, so that its old level can still be read.
    """

    def __init__(self) -> None:
        self.before_change: Callable[[], None] = lambda: None
        self._outputs: dict[PinName, float] = {}
        self._inputs: dict[PinName, Level] = {}
        self._volts: dict[PinName, Volts] = {}

    def level(self, pin: PinName) -> float:
        """Return the output level of ``pin``; 0 if it is not an output."""
        return self._outputs.get(pin, 0.0)

    def put(self, pin: PinName, level: float) -> None:
        if self._outputs.get(pin, 0.0) != level:
            self.before_change()
            self._outputs[pin] = level

    def float_all(self) -> None:
        """Turn all outputs off, as a reset does."""
        if any(self._outputs.values()):
            self.before_change()
            self._outputs.clear()

    def set_input(self, pin: PinName, high: Level) -> None:
        """Drive ``pin`` high or low from outside; None leaves it to the pull resistors."""
        self._inputs[pin] = high

    def driven(self, pin: PinName) -> bool | None:
        high = self._inputs.get(pin)
        return high() if callable(high) else high

    def set_volts(self, pin: PinName, volts: Volts) -> None:
        self._volts[pin] = volts

    def volts(self, pin: PinName) -> float:
        volts = self._volts.get(pin, 0.0)
        return volts() if callable(volts) else volts
