"""The simulated robots of the demo, before they are started."""

from __future__ import annotations

from pathlib import Path

from pebble.rig.testbed import LinuxRobot, McuRobot


def test_a_robot_without_outlets_has_switched_no_relay(tmp_path: Path) -> None:
    robots = [LinuxRobot("fred", tmp_path, 1, 2), McuRobot("benjr", tmp_path, "ESP8266", 2)]
    assert [robot.relays() for robot in robots] == [[], []]
