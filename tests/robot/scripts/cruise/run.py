"""Drives the same way for ever."""

from typing import Annotated

from msgspec import Meta, Struct

from pebble import Robot, run


class Options(Struct):
    x: float = 0.0
    z: float = 0.3
    rate_hz: Annotated[float, Meta(ge=1, le=500)] = 20.0


def main(robot: Robot, options: Options) -> None:
    while True:
        robot.drive(options.x, options.z)
        robot.sleep(1 / options.rate_hz)


run(main)
