"""Puts a robot's camera and microphone in use: a program on the robot reads frames, an operator gets video and audio.

As a process: ``python -m pebble.bench.bridge_media frames RUN_DIR`` or ``media PORT BASE``. It answers every line with
the counts so far.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from pathlib import Path
from typing import Self

from paho.mqtt.client import MQTTMessage

from pebble.bench.bridge_operator import Operator
from pebble.contract import AUDIO, CAMERA
from pebble.errors import PebbleError
from pebble.rig.robot import Robot
from pebble.rig.stock_client import StockClient
from pebble.rig.worker import Worker
from pebble.rig.worker_end import serve, serve_on_thread
from pebble.transports.frames import FrameReader

FLOWS = ("frames", "video", "audio")
_START_S = 20.0
_STOP_S = 10.0
_ANSWER_S = 5.0
_POLL_S = 0.1
_READ_S = 0.2
_EVERY = 16  # bytes: one in so many of a picture's is read


class MediaLoad:
    """Starts all media in ``with`` and waits until they flow; stops them at the end."""

    def __init__(self, robot: Robot, operator: Operator) -> None:
        self._robot, self._operator = robot, operator
        self._workers: list[Worker] = []
        self._before = 0  # processes of the robot without media

    def __enter__(self) -> Self:
        """Raises PebbleError naming what does not flow."""
        self._before, start = len(self._robot.pids()), self._robot.running.worker
        module, where = "pebble.bench.bridge_media", (self._robot.remote_port, self._robot.base)
        try:
            self._workers.append(start("frame reader", module, "frames", self._robot.run_dir))
            self._workers.append(start("media operator", module, "media", *where))
            self._operator.media(True)
            self._wait()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._operator.media(False)
        for worker in self._workers:
            self._robot.running.end(worker)
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


def main(arguments: list[str]) -> int:
    what, *where = arguments
    counts: Counter[str] = Counter()
    if what == "frames":
        _read_frames(Path(where[0]), counts)
    else:
        _watch(int(where[0]), where[1], counts)
    return 0


def _read_frames(run_dir: Path, counts: Counter[str]) -> None:
    ended = serve_on_thread(lambda _line: dict(counts))
    with FrameReader(run_dir, "camera", views=True) as reader:
        while not ended.is_set():
            frame = reader.read(_READ_S)
            if frame is not None:
                counts["frames"] += bool(frame.data[::_EVERY].any())
                frame.release()


def _watch(port: int, base: str, counts: Counter[str]) -> None:
    names = {CAMERA.topic(base): "video", AUDIO.topic(base): "audio"}

    def count(message: MQTTMessage) -> None:
        name = names[message.topic]
        counts[name] += 1
        counts[f"{name}_bytes"] += len(message.payload)

    client = StockClient(count, [(topic, 0) for topic in names], at_once=False).open(port)
    serve(lambda _line: dict(counts))
    client.close()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
