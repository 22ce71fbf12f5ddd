"""BenJr's motor shield, byte by byte."""

from benjr.motor_shield import FREQUENCY, turn


def test_its_messages() -> None:
    assert bytes((0, 0, 1000 >> 8, 1000 & 255)) == FREQUENCY
    for motor, speed, message in (
        (0, 1.0, b"\x10\x02\x27\x10"),  # clockwise, 100.00 %
        (1, -0.5, b"\x11\x01\x13\x88"),  # the other way, 50.00 %
        (0, 0.0, b"\x10\x03\0\0"),
        (1, 0.00001, b"\x11\x03\0\0"),  # less than the shield can do
    ):
        assert turn(motor, speed) == message, speed
