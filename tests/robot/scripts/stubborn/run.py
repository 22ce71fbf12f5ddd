"""Drives for ever: it ignores SIGTERM, and goes on after each error."""

import signal
import time
from contextlib import suppress

from pebble import Robot, run


def main(robot: Robot) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    while True:
        with suppress(BaseException):
            robot.drive(z=-0.3)
        time.sleep(0.05)


run(main)
