"""I2C messages of the WEMOS D1 mini motor shield v1.0.0 (TB6612FNG behind an STM32F030). Pure.

Four bytes a message (github.com: wemos/WEMOS_Motor_Shield_Arduino_Library, src/WEMOS_Motor.cpp, and
pbugalski/wemos_motor_shield, src/user_i2c.c): 0, then the PWM frequency in Hz in three bytes, high byte first; or
0x10 + motor, direction, duty cycle in 1/100 % in two bytes, high byte first. All directions but standby (4) take the
chip out of standby. The shield has no watchdog: its motors keep running when its master fails.
"""

from micropython import const

_CCW = const(1)
_CW = const(2)
_STOP = const(3)  # lets the motor coast; 0 would brake

FREQUENCY = b"\x00\x00\x03\xe8"  # 1 kHz


def turn(motor: int, speed: float) -> bytes:
    """Return the message that turns motor 0 (A) or 1 (B) at ``speed``, -1..1, + = clockwise."""
    duty = int(abs(speed) * 10_000)
    return bytes((0x10 | motor, _STOP if not duty else _CW if speed > 0.0 else _CCW, duty >> 8, duty & 255))
