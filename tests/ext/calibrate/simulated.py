"""A robot in a simulated room whose wheels differ from what is believed, and the person who measures it."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pebble.contract import IMU_FAST, MOTOR_POWER, TOUCH_SENSORS
from pebble.contract.payloads import Drive, TouchSensors
from pebble.extensions.calibrate.wheels import Wanted, calibrate
from pebble.extensions.lab.simulation.motion import Wheels
from pebble.extensions.lab.simulation.world.script_robot import SimulatedRobot
from tests.ext.scripts.perception.wheels_rig import powers, touches, turning

TRUE = Wheels(61.0 * 1.01, 61.0 * 0.99, 130.5 * 1.03)
ROOM = {"x_min": -0.5, "x_max": 2.4, "y_min": -2.0, "y_max": 2.0}
TAG = {"id": 13, "x": 2.3, "y": 0.0, "z": 0.2, "yaw_deg": 180.0}


class Measured(SimulatedRobot):
    """A robot that publishes its hall sensors, and an inertial sensor if there is ``gyro``.

    ``at_step`` is called at each step of the clock.
    """

    def __init__(self, folder: Path, wheels: Wheels = TRUE, *, gyro: bool = False, noise: random.Random) -> None:
        sizes = {
            "left_wheel_mm": wheels.left_diameter_mm,
            "right_wheel_mm": wheels.right_diameter_mm,
            "track_mm": wheels.track_mm,
        }
        world = {"room": ROOM, "tags": [TAG], "robots": {"goob": {"x": 0.0, "y": 0.0, **sizes}}}
        (folder / "room.json").write_text(json.dumps(world))
        super().__init__(folder / "room.json")
        self.at_step: Callable[[], None] = lambda: None
        self.turned = 0.0
        self._gyro, self._noise, self._received = gyro, noise, b""
        self._heading = self.body.pose.heading

    def _pass_step(self) -> None:
        super()._pass_step()
        self.turned += math.remainder(self.body.pose.heading - self._heading, math.tau)
        self._heading = self.body.pose.heading
        found, self._received = touches(self._received + self.body.read(), lambda: self._noise.gauss(0, 2))
        for values in found:
            self.receive(TOUCH_SENSORS, TouchSensors(value=values))
        if self._gyro and round(self.world.now() * 1000) % 10 == 0:
            motion = self.body.motion
            z = math.degrees((motion.right_mm_s - motion.left_mm_s) / motion.wheels.track_mm)
            self.receive(IMU_FAST, turning(z + 0.3 + self._noise.gauss(0.0, 0.05), self.world.now()))
        self.at_step()

    def _drive(self, command: Drive) -> bool:
        self.receive(MOTOR_POWER, powers(command))
        return super()._drive(command)


class Measurer:
    """A person who puts the robot on the line before each run and measures after it, with a tape's and an eye's errors.

    ``slips`` are what is typed wrongly: millimetres added to the way, by the number of the straight.
    """

    def __init__(self, robot: Measured, noise: random.Random, slips: dict[int, float] | None = None) -> None:
        self.told: list[str] = []
        self._robot, self._noise, self._slips = robot, noise, slips or {}
        self._straights = 0
        self._began = robot.body.pose
        self._turned = 0.0

    def tell(self, line: str) -> None:
        self.told.append(line)

    def ask(self, question: str) -> str:
        robot, gauss = self._robot, self._noise.gauss
        if "Enter drives" in question:
            if "line" in question:
                robot.body.place(1.6 if "back" in question else 0.0, 0.0, gauss(0, math.radians(0.3)))
            self._began, self._turned = robot.body.pose, robot.turned
            return ""
        if "degrees" in question:
            past = abs(robot.turned - self._turned) - 3 * math.tau
            return f"{math.degrees(past) + gauss(0, 2):.0f}"
        end, self._straights = robot.body.pose, self._straights + 1
        along = abs(end.x - self._began.x) * 1000 + gauss(0, 2) + self._slips.pop(self._straights, 0.0)
        beside = f" {end.y * 1000 + gauss(0, 3):.0f}" if "left of it" in question else ""
        return f"{along:.0f}{beside}"


def measure(folder: Path, seed: int = 0, wanted: Wanted | None = None, **options: Any) -> tuple[Measured, Measurer]:
    """Run a whole calibration, or as much as is possible; ``at_step(robot)`` at each step of the clock."""
    noise = random.Random(seed)
    at_step, slips = options.pop("at_step", lambda _: None), options.pop("slips", None)
    robot = Measured(folder, noise=noise, **options)
    person = Measurer(robot, noise, slips)
    robot.at_step = lambda: at_step(robot)
    robot.run(lambda robot: calibrate(robot, person, wanted or Wanted(), robot.world.now), seconds=900)
    return robot, person
