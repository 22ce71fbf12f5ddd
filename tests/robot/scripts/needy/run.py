"""Drives while ``crash`` does, which it needs."""

from pebble import Robot, run


def main(robot: Robot) -> None:
    while True:
        robot.drive(z=0.2)
        robot.sleep(0.05)


run(main, needs={"crash": {}})
