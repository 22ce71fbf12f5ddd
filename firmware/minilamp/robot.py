"""MiniLAMP: two wheels and a pair of grousers, all either on or off, on a XIAO ESP32-C6."""

from machine import ADC, Pin
from micropython import const

from common.drv8833 import Motor
from common.payload import mix
from common.settings import get
from minilamp import pins
from wifi.network_robot import NetworkRobot
from wifi.tls import Wrapper

_THRESHOLD = const(0.25)  # below it a motor stays off


class Body:
    axes = b',"y"'  # its grousers
    groups = b'"groups":["drive-values"],'

    def __init__(self) -> None:
        self._motors = [Motor(pair) for pair in (pins.LEFT, pins.RIGHT, pins.GROUSERS)]
        self._battery = ADC(Pin(pins.BATTERY), atten=ADC.ATTN_11DB)
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

    def refresh(self) -> None:
        """Do nothing: the motors need no refresh."""

    def report(self, publish) -> None:
        volts = self._battery.read_u16() * (pins.BATTERY_FULL_V / 65535)
        publish(b"charging-level", b'{"value": %.3f, "unit": "v"}' % volts)


def build(settings: dict) -> NetworkRobot:
    body = Body()  # before anything else: motors off
    tls = get(settings, "mqtt", "tls", False)
    wrap = Wrapper(tls) if tls else None
    return NetworkRobot(settings, body, b"false", wrap)
