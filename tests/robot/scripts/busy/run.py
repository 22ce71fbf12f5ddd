"""Drives for half a second, and then calls nothing of the robot for ever."""

from pebble import Robot, run


def main(robot: Robot) -> None:
    for _ in range(10):
        robot.drive(z=-0.3)
        robot.sleep(0.05)
    while True:
        pass


run(main)
