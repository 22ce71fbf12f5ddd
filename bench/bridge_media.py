"""Puts a robot's camera and microphone in use: frames for a program on the robot, video and audio for an operator."""

from __future__ import annotations

import sys
import time
from typing import Self

from pebble.bench.bridge_operator import Operator
from pebble.bench.bridge_robot import BASE, RobotProcesses
from pebble.bench.worker import Worker, end_workers
from pebble.errors import PebbleError

FLOWS = ("frames", "video", "audio")
_START_S = 20.0
_STOP_S = 10.0
_ANSWER_S = 5.0
_POLL_S = 0.1


class MediaLoad:
    """Starts all media in ``with`` and waits until they flow; stops them at the end."""

    def __init__(self, robot: RobotProcesses, operator: Operator) -> None:
        self._robot, self._operator = robot, operator
        self._workers: list[Worker] = []
        self._before = 0  # processes of the robot without media

    def __enter__(self) -> Self:
        """Raises PebbleError naming what does not flow."""
        module, log = [sys.executable, "-m", "pebble.bench.bridge_load"], self._robot.run_dir.with_name("load.log")
        self._before = len(self._robot.pids())
        try:
            self._workers += [
                Worker("the frame reader", [*module, "frames", str(self._robot.run_dir)], log),
                Worker("the media operator", [*module, "media", str(self._robot.remote_port), BASE], log),
            ]
            self._operator.media(True)
            self._wait()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._operator.media(False)
        end_workers(self._workers)
        end = time.monotonic() + _STOP_S
        while len(self._robot.pids()) > self._before and time.monotonic() < end:
            time.sleep(_POLL_S)

    def counts(self) -> dict[str, int]:
        """Counts of received frames and packets so far, by flow."""
        for worker in self._workers:
            worker.send("")
        found = {name: count for worker in self._workers for name, count in worker.answer(_ANSWER_S).items()}
        return {name: found.get(name, 0) for name in FLOWS}

    def _wait(self) -> None:
        end = time.monotonic() + _START_S
        while missing := [name for name, count in self.counts().items() if not count]:
            if time.monotonic() > end:
                raise PebbleError(f"no {', '.join(missing)} after {_START_S:.0f} s\n{self._robot.log()}")
            time.sleep(_POLL_S)
