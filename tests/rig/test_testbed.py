"""The simulated robots of the demo, before they are started."""

from __future__ import annotations

from pebble.rig.processes import Processes
from pebble.rig.testbed import LinuxRobot, McuRobot


def test_a_robot_without_outlets_has_switched_no_relay() -> None:
    with Processes() as processes:
        robots = [LinuxRobot(processes, "fred", 1, 2), McuRobot(processes, "benjr", "ESP8266", 2)]
        assert [robot.relays() for robot in robots] == [[], []]
