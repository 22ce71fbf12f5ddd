"""The errors of a simulated board: those its firmware gets, and those that are for people."""

from __future__ import annotations

import os


def failure(code: int) -> OSError:
    """An OSError as MicroPython raises it. CPython knows the ``errno`` only of one that has a text, too."""
    return OSError(code, os.strerror(code))


class FirmwareFault(BaseException):
    """The firmware did something that a real board would not survive. No firmware can catch it: it is for people."""


class WouldHang(FirmwareFault):
    """A call that would never return."""


class SharedPwm(FirmwareFault):
    """Two pins on one PWM channel: both would show the signal that was set last."""
