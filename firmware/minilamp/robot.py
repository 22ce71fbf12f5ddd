"""MiniLAMP: two wheels and a pair of grousers, all either on or off, on a XIAO ESP32C6."""

from machine import ADC, Pin

from common.battery import Battery
from common.drv8833 import Motor
from common.network_robot import NetworkRobot
from common.settings import get
from common.tls import Wrapper
from common.wheels import mix
from minilamp import pins

_THRESHOLD = 0.25  # below it a motor stays off


class Body:
    def __init__(self) -> None:
        self._motors = [Motor(pair) for pair in (pins.LEFT, pins.RIGHT, pins.GROUSERS)]
        self._battery = Battery(ADC(Pin(pins.BATTERY), atten=ADC.ATTN_11DB), pins.BATTERY_FULL_V)
        for pin in pins.ANTENNA:
            Pin(pin, Pin.OUT, value=0)

    def drive(self, x: float, z: float, y: float) -> bool:
        moving = False
        for motor, wish in zip(self._motors, mix(x, z) + (y,)):
            speed = 0.0 if abs(wish) < _THRESHOLD else 1.0 if wish > 0.0 else -1.0
            motor.set(speed)
            moving = moving or speed != 0.0
        return moving

    def stop(self) -> None:
        for motor in self._motors:
            motor.stop()

    def keep(self) -> None:
        """Nothing to do every turn."""

    def report(self, say) -> None:
        say(b"charging-level", b'{"value": %.3f, "unit": "v"}' % self._battery.volts())


def build(settings: dict) -> NetworkRobot:
    body = Body()  # before anything else: motors off
    tls = get(settings, "mqtt", "tls", False)
    wrap = Wrapper(tls, get(settings, "mqtt", "host")) if tls else None
    return NetworkRobot(settings, body, b"false", wrap)
