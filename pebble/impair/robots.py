"""The robots behind the links: each with a broker, an operator, a link and an MCU of its own, all of them processes."""

from __future__ import annotations

import json
import sys
import tempfile
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec

from pebble.bench.frames_process import Worker, end_workers
from pebble.demo.broker import free_port, mosquitto_command
from pebble.demo.programs import Program, end_all
from pebble.errors import PebbleError
from pebble.impair.link import Link, open_link
from pebble.impair.messages import Order, Said, Settle
from pebble.impair.plan import Subject
from pebble.simulation.trace import Entry, read_trace
from pebble.transports.segments import sweep

BASE = "pebble/robots/rover"
WIDTH, HEIGHT, FPS = 640, 480, 15  # as the original is configured
_AUDIO_RATE = 16_000
_MCU_START_S = 15.0
_ROBOTS_END_S, _REST_END_S = 6.0, 2.0
_LOG_TAIL = 2000  # characters


class Robot:
    """One subject. The local broker and all the robot's processes are on its side of the link; the rest is beyond."""

    def __init__(self, subject: Subject, kind: str, folder: Path) -> None:
        self.subject = subject
        self.operator: Worker | None = None
        self.launcher: Program | None = None
        self.programs: list[Program] = []
        self._folder = folder
        self._folder.mkdir()
        self._trace = folder / "trace.jsonl"
        self.link: Link = open_link(kind, name=subject.name)
        self._port, self._local_port = free_port(), free_port()

    def start(self) -> None:
        """Everything, one after the other; the robot is not yet up. Raises PebbleError."""
        remote = mosquitto_command(self._port, self._folder / "remote", host=self.link.broker_host)
        self._start("remote broker", self.link.on_remote(remote))
        if self.subject.transport == "mqtt":
            self._start("local broker", self.link.on_robot(mosquitto_command(self._local_port, self._folder / "local")))
        port = self._folder / "mcu"
        self._trace.touch()
        simulation = [sys.executable, "-m", "pebble.simulation.mcu", "--kind", "goob"]
        mcu = self._start("MCU", [*simulation, "--link", str(port), "--trace", str(self._trace)])
        mcu.wait_until(port.exists, _MCU_START_S, threading.Event())
        config = self._folder / "robot.json"
        config.write_text(json.dumps(self._config(port), indent=1))
        command = [sys.executable, "-m", "pebble.cli", "up", str(config)]
        self.launcher = Program(f"robot of {self.subject.name}", self.link.on_robot(command), self._log("robot"))
        operator = [sys.executable, "-m", "pebble.impair.operator", self.link.broker_host, str(self._port), BASE]
        name = f"the operator of {self.subject.name}"
        self.operator = Worker(name, self.link.on_remote(operator), self._log("operator"))

    def tell(self, order: Order | Settle) -> None:
        if self.operator is not None:
            with suppress(BrokenPipeError):  # it has ended: what it says last tells why
                self.operator.tell(msgspec.json.encode(order).decode())

    def hear(self, timeout: float) -> Said:
        """What the operator says next. Raises PebbleError if that is a problem, or nothing, or a program has ended."""
        if self.operator is None:
            raise PebbleError(f"{self.subject.name} was not started")
        try:
            said = msgspec.convert(self.operator.answer(timeout), Said)
        except PebbleError as error:
            said = Said(problem=str(error))
        if ended := next((each for each in (*self.programs, self.launcher) if each is not None and each.ended), None):
            raise PebbleError(f"{ended.name} has ended\n{_tail(ended.log)}".rstrip())
        if said.problem is not None:
            raise PebbleError(f"{self.subject.name}: {said.problem}\n{_tail(self._log('robot'))}".rstrip())
        return said

    def entries(self, since_ns: int) -> list[Entry]:
        """What reached the MCU after ``since_ns``."""
        return [entry for entry in read_trace(self._trace) if entry.ns >= since_ns]

    def _start(self, name: str, command: Sequence[str]) -> Program:
        program = Program(f"{name} of {self.subject.name}", command, self._log(name.replace(" ", "-")))
        self.programs.append(program)
        return program

    def _log(self, name: str) -> Path:
        return self._folder / f"{name}.log"

    def _config(self, port: Path) -> dict[str, Any]:
        """With the original's keys and values wherever it has them."""
        host, remote_port = self.link.broker_address(self._port)
        video = {"publish_width": WIDTH, "publish_height": HEIGHT, "publish_fps": FPS, "keyframe_interval": 5}
        audio = {"rate": _AUDIO_RATE, "channels": 1, "chunk_ms": 20}
        services: dict[str, Any] = {
            "mqtt_bridge": {
                "enabled": True,
                "remote_mqtt": {"host": host, "port": remote_port},
                "media": {"video_publisher": {**video, "jpeg_quality": 10}, "audio_publisher": audio},
            },
            "serial_mcu_bridge": {"enabled": True, "serial": {"port": str(port), "baud": 460_800}},
            "av_daemon": {
                "enabled": True,
                "video": {"backend": "synthetic", "width": WIDTH, "height": HEIGHT, "fps": FPS},
                "audio": {"source": "synthetic", "rate": _AUDIO_RATE, "channels": 1},
            },
        }
        transport = {"kind": self.subject.transport, "run_dir": str(self._folder / "run")}
        config: dict[str, Any] = {"robot": {"id": "rover"}, "transport": transport, "services": services}
        if self.subject.transport == "mqtt":
            config["local_mqtt"] = {"host": "127.0.0.1", "port": self._local_port}
        return config


class Field:
    """All robots at once, in a folder that goes with them."""

    def __init__(self, subjects: Sequence[Subject], kind: str) -> None:
        self.robots: list[Robot] = []
        self._subjects, self._kind = subjects, kind
        self._folder = tempfile.TemporaryDirectory(prefix="pbl-")

    def __enter__(self) -> Self:
        """Starts everything; the robots are not yet up. Raises PebbleError."""
        try:
            for number, subject in enumerate(self._subjects):
                self.robots.append(Robot(subject, self._kind, Path(self._folder.name) / str(number)))
            for robot in self.robots:
                robot.start()
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        """Robots before those they say their last words to, and links last."""
        end_workers(robot.operator for robot in self.robots if robot.operator is not None)
        end_all((robot.launcher for robot in self.robots if robot.launcher is not None), _ROBOTS_END_S)
        end_all((program for robot in self.robots for program in robot.programs), _REST_END_S)
        for robot in self.robots:
            robot.link.close()
        self._folder.cleanup()
        sweep()

    def hurry(self) -> None:
        """Have all operators stop what they are doing."""
        for robot in self.robots:
            if robot.operator is not None:
                robot.operator.ask_to_end()


def _tail(log: Path) -> str:
    return log.read_text(errors="replace")[-_LOG_TAIL:] if log.exists() else ""
