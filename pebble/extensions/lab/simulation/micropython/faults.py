"""The errors of a simulated board: those that its firmware receives, and those that report a bug in the firmware."""

import os


def failure(code: int) -> OSError:
    """Return an OSError as MicroPython raises it. CPython sets ``errno`` only if there is a text, too."""
    return OSError(code, os.strerror(code))


class FirmwareFault(BaseException):
    """An error: the firmware did what fails on a real board. A BaseException, so that firmware does not catch it."""


class WouldHang(FirmwareFault):
    """An error: the call would never return on a real board."""


class SharedPwm(FirmwareFault):
    """An error: two pins share one PWM channel, so that both would have the signal set last."""
