"""The battery's voltage behind a divider. A driver."""


class Battery:
    """``adc`` reads 0..65535; ``full_scale`` is the battery's voltage at 65535."""

    def __init__(self, adc, full_scale: float) -> None:
        self._adc = adc
        self._scale = full_scale / 65535

    def volts(self) -> float:
        return self._adc.read_u16() * self._scale
