"""Drives for half a second, then ends with exit code 3."""

import sys

from pebble import Robot, run


def main(robot: Robot) -> None:
    for _ in range(10):
        robot.drive(z=0.3)
        robot.sleep(0.05)
    sys.exit(3)


run(main)
