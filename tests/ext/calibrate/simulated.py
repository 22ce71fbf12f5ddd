"""A robot in a simulated room whose wheels differ from what is believed, and the person who measures it."""

from __future__ import annotations

import json
import math
import random
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pebble.contract import IMU_FAST, MOTOR_POWER, TOUCH_SENSORS
from pebble.contract.payloads import (
    Drive,
    ImuFast,
    ImuFastValues,
    MotorPower,
    Orientation,
    TouchSensors,
    TouchValues,
    Vector,
)
from pebble.extensions.calibrate.wheels import Wanted, calibrate
from pebble.extensions.lab.simulation.motion import Wheels
from pebble.extensions.lab.simulation.world.script_robot import SimulatedRobot

TRUE = Wheels(61.0 * 1.01, 61.0 * 0.99, 130.5 * 1.03)
ROOM = {"x_min": -0.5, "x_max": 2.4, "y_min": -2.0, "y_max": 2.0}
TAG = {"id": 13, "x": 2.3, "y": 0.0, "z": 0.2, "yaw_deg": 180.0}
_touch = re.compile(rb"T a0=(\d+) a1=(\d+) a2=(\d+)").fullmatch


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
        *lines, self._received = (self._received + self.body.read()).split(b"\n")
        for found in filter(None, map(_touch, (line.strip() for line in lines))):
            a0, a1, a2 = (int(value) + round(self._noise.gauss(0, 2)) for value in found.groups())
            self.receive(TOUCH_SENSORS, TouchSensors(value=TouchValues(a0=a0, a1=a1, a2=a2)))
        if self._gyro and round(self.world.now() * 1000) % 10 == 0:
            self.receive(IMU_FAST, self._imu())
        self.at_step()

    def _drive(self, command: Drive) -> bool:
        left, right = (max(-1.0, min(1.0, power)) for power in (command.z + command.x, command.z - command.x))
        self.receive(MOTOR_POWER, MotorPower(left=left, right=right))
        return super()._drive(command)

    def _imu(self) -> ImuFast:
        motion = self.body.motion
        z = math.degrees((motion.right_mm_s - motion.left_mm_s) / motion.wheels.track_mm)
        values = ImuFastValues(
            accel_mps2=Vector(x=0, y=0, z=9.81),
            gyro_dps=Vector(x=0, y=0, z=z + 0.3 + self._noise.gauss(0.0, 0.05)),
            temp_c=30.0,
            orientation_deg=Orientation(roll=0, pitch=0),
        )
        return ImuFast(t=0, seq=0, mcu_ms=round(self.world.now() * 1000), value=values)


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
