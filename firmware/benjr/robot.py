"""BenJr: a walker on two motors, behind I2C shields, on a D1 mini (ESP8266)."""

from machine import ADC, Pin, SoftI2C
from micropython import const

from benjr import motor_shield, pins
from common.payload import mix
from common.settings import get
from wifi.network_robot import NetworkRobot

_I2C_HZ = const(100_000)
_I2C_TIMEOUT_US = const(2000)  # for a shield that stretches the clock


class Body:
    """Both motors on the shield. Messages that the shield did not acknowledge are repeated every turn."""

    def __init__(self) -> None:
        self._i2c = SoftI2C(scl=Pin(pins.SCL), sda=Pin(pins.SDA), freq=_I2C_HZ, timeout=_I2C_TIMEOUT_US)
        self._battery = ADC(pins.BATTERY)
        self.failures = 0  # messages that the shield did not acknowledge
        self.stop()

    def drive(self, x: float, z: float, _y: float) -> bool:
        """Drive; return True if anything moves. Both motors are mounted in reverse: throttle negated, sides swapped."""
        b, a = mix(x, -z)
        self._waiting = [motor_shield.FREQUENCY, motor_shield.turn(1, b), motor_shield.turn(0, a)]
        self.refresh()
        return a != 0.0 or b != 0.0

    def stop(self) -> None:
        self.drive(0.0, 0.0, 0.0)

    def refresh(self) -> None:
        try:
            while self._waiting:
                self._i2c.writeto(pins.MOTOR_SHIELD, self._waiting[-1])
                self._waiting.pop()
        except OSError:
            self.failures += 1

    def report(self, publish) -> None:
        volts = self._battery.read_u16() * pins.BATTERY_FULL_V / 65535
        publish(b"charging-level", b'{"value": %.3f, "unit": "v"}' % volts)
        publish(b"charging-status", b'{"value": false}')  # it cannot drive on the charger


def build(settings: dict) -> NetworkRobot:
    body = Body()  # before anything else: motors off
    if get(settings, "mqtt", "tls", False):
        raise ValueError("mqtt.tls: this board has no memory for it")
    return NetworkRobot(settings, body, b"true", None)
