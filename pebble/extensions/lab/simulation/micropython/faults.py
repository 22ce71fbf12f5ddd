"""The errors of a simulated board: those that its firmware receives, and those that report a bug in it."""

import os


def failure(code: int) -> OSError:
    """Make an OSError as MicroPython raises it. CPython sets ``errno`` only if there is a text too."""
    return OSError(code, os.strerror(code))


class FirmwareFault(BaseException):
    """The firmware did something that fails on a real board. A BaseException, so that no firmware catches it."""


class WouldHang(FirmwareFault):
    """A call that would never return."""


class SharedPwm(FirmwareFault):
    """Two pins share one PWM channel: both would have the signal that was set last."""
