"""A whole robot of the package under a real systemd: it drives, stops, shows and sounds within its unit's limits."""

from __future__ import annotations

import pytest

from tests.kit.machine import Machine
from tests.life.robots import Robot
from tests.support import until


def test_a_robot_with_media_drives_stops_shows_and_sounds(machine: Machine) -> None:
    robot = Robot(machine)
    robot.configure()
    robot.plug_in()
    robot.start()
    for flag, ask in (("mqtt-video", "front-camera"), ("mqtt-audio", "audio")):
        robot.send(f"incoming/flags/{flag}", True, "-r")
        robot.send(f"incoming/{ask}", {"enabled": True})
    assert robot.receives("outgoing/front-camera")
    assert robot.receives("outgoing/audio")
    assert not robot.board.turning()
    robot.send("incoming/drive-values", {"x": 0, "z": 0.5})
    assert until(robot.board.motors, 10, step=0.1), "it drives"
    assert until(lambda: not robot.board.turning(), 10, step=0.1), "it stops without further commands"
    status = machine.sh("cat /proc/$(systemctl show --value --property=MainPID pebble.service)/status")
    assert "Seccomp:\t2" in status
    assert "CapBnd:\t0000000000000000" in status
    assert "not permitted" not in machine.journal("pebble.service")


@pytest.mark.parametrize("signal", ["KILL", "ABRT"])
def test_a_robot_that_ends_comes_back_from_its_slot(machine: Machine, signal: str) -> None:
    robot = Robot(machine)
    robot.configure()
    robot.plug_in()
    robot.start()
    machine.run("systemctl", "kill", "--kill-whom=main", f"--signal={signal}", "pebble.service")
    assert robot.receives("outgoing/online")
    assert robot.runs_from() == "a"
