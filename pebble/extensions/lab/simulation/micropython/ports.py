"""The differences between MicroPython's ports that matter to our firmware."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

from pebble.extensions.lab.simulation.micropython import samd21
from pebble.extensions.lab.simulation.micropython.pins import PinName


@dataclass(frozen=True, slots=True)
class Port:
    """A board type: names of pins, range of the ADC, timeouts of the watchdog, modules that are absent."""

    platform: str
    board: str
    pin: Callable[[PinName], PinName]  # resolves the name of a pin; ValueError if there is none
    adc_v: float  # the voltage at which the ADC reads its highest value
    wdt_ms: Callable[[int], int]  # actual timeout of the watchdog for a requested one; ValueError if unsupported
    absent: frozenset[str] = frozenset()  # modules that the image lacks
    stdio_bytes: bool = True  # sys.stdin.buffer and sys.stdout.buffer


def _samd_pin(name: PinName) -> PinName:
    return samd21.pin(name) if isinstance(name, str) else _refuse(name)


def _esp_pin(name: PinName) -> PinName:
    return name if isinstance(name, int) else _refuse(name)


def _refuse(name: PinName) -> PinName:
    raise ValueError(f"not a Pin of this board: {name!r}")


def _samd_wdt(timeout_ms: int) -> int:
    """Return the watchdog's real timeout: a power of two, rounded down (ports/samd/machine_wdt.c)."""
    return 1 << (max(512, min(16_384, timeout_ms)).bit_length() - 1)


def _esp8266_wdt(timeout_ms: int) -> int:
    if timeout_ms != 5000:
        raise ValueError("the watchdog of an ESP8266 supports a timeout of 5000 ms only")
    return timeout_ms


_XIAO: Final = "Seeed Xiao with SAMD21G18A"
#: The ADC's reference is half the supply (MICROPY_HW_ADC_VREF 2 of the board, gain 1): it reads up to 1.65 V.
#: This image has SAMD21_EXTRA_FEATURES (ports/samd/mcu/samd21/mpconfigmcu.h), the official one does not.
SAMD21: Final = Port("samd", _XIAO, _samd_pin, 1.65, _samd_wdt, frozenset({"hashlib"}))
SAMD21_OFFICIAL: Final = replace(SAMD21, absent=frozenset({"hashlib", "select", "errno"}), stdio_bytes=False)
ESP32_C6: Final = Port("esp32", "ESP32C6 module with ESP32C6", _esp_pin, 3.3, lambda ms: ms)
#: The ADC itself reads up to 1 V; a Wemos D1 mini has a divider in front of it for 3.2 V
ESP8266: Final = Port("esp8266", "ESP module with ESP8266", _esp_pin, 1.0, _esp8266_wdt)

#: The board type of each robot
OF_ROBOT: Final = {
    **dict.fromkeys(("goob", "fred", "goob_imu"), SAMD21),
    "minilamp": ESP32_C6,
    "benjr": ESP8266,
}
