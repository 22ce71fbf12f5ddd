"""A stand-in for the original's wheel-odometry, without its code: hall samples, and drive commands for their sign.

It counts how often a wheel's sensor crosses its middle, and each gap in the numbers of the samples.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from typing import Any

from tests.fakes.original_media import Robot
from tests.kit.hall_reader import HallReader, Sample

POLL_S, RETRY_S, PUBLISH_S = 0.005, 1.0, 0.05
WHEEL_MM, MAGNETS = 61.0, 10
STEP_MM = math.pi * WHEEL_MM / MAGNETS  # between two of them, whose poles alternate
SWING = 60


class Wheel:
    """One sensor; ``sign`` is that of the last command that moved the wheel."""

    def __init__(self) -> None:
        self.sign, self.mm = 1.0, 0.0
        self._low = self._high = self._above = None

    def take(self, value: int) -> None:
        self._low = value if self._low is None else min(self._low, value)
        self._high = value if self._high is None else max(self._high, value)
        middle = (self._low + self._high) / 2
        if self._high - self._low < SWING or abs(value - middle) < (self._high - self._low) / 8:
            return
        above = value > middle
        if self._above is not None and above is not self._above:
            self.mm += self.sign * STEP_MM
        self._above = above


class Odometry:
    def __init__(self) -> None:
        self.left, self.right = Wheel(), Wheel()
        self.samples = self.gaps = self.number = 0

    def receive(self, payload: bytes) -> None:
        try:
            self.drive(json.loads(payload))
        except ValueError:  # no command, such as a bridge's probe
            return

    def drive(self, command: dict[str, Any]) -> None:
        x, z = command.get("x", 0.0), command.get("z", 0.0)
        for wheel, power in ((self.left, z + x), (self.right, z - x)):
            if power:
                wheel.sign = math.copysign(1.0, power)

    def take(self, sample: Sample) -> None:
        if self.number:
            self.gaps += sample.number - self.number - 1
        self.number = sample.number
        self.samples += 1
        self.left.take(sample.a0)
        self.right.take(sample.a1)

    def found(self) -> dict[str, Any]:
        distance = (self.left.mm + self.right.mm) / 2
        return {"x_mm": distance, "y_mm": 0.0, "samples": self.samples, "gaps": self.gaps}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--config", required=True)
    parser.add_argument("--shm-name", default="")
    options = parser.parse_args()
    robot, odometry = Robot(options.config, "odometry"), Odometry()
    robot.client.on_connect = lambda client, *_: client.subscribe(f"{robot.base}/incoming/drive-values")
    robot.client.on_message = lambda _client, _data, message: odometry.receive(message.payload)
    robot.connect()
    reader = _opened(options.shm_name or f"{robot.base.replace('/', '_')}_odometry_raw")
    due = 0.0
    while True:
        for sample in reader.read():
            odometry.take(sample)
        if time.monotonic() >= due:
            due = time.monotonic() + PUBLISH_S
            robot.publish("outgoing/wheel-odometry", {"value": odometry.found()})
        time.sleep(POLL_S)


def _opened(name: str) -> HallReader:
    while True:
        try:
            return HallReader(name)
        except (FileNotFoundError, ValueError):
            time.sleep(RETRY_S)


if __name__ == "__main__":
    main()
