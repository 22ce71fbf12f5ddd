"""The robots of the trials, as processes: each with its own broker, operator, impaired network and simulated MCU."""

from __future__ import annotations

import json
import sys
import tempfile
import threading
import wave
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec

from pebble.bench.impair.messages import OperatorReport, RecoveryRequest, TrialRequest
from pebble.bench.impair.network import ImpairedNetwork, open_network
from pebble.bench.impair.operator import CLIP
from pebble.bench.impair.plan import Subject
from pebble.bench.worker import Worker, end_workers
from pebble.errors import PebbleError
from pebble.media.pcm import to_bytes
from pebble.media.speech import Speech
from pebble.rig.broker import free_port, mosquitto_command
from pebble.rig.programs import Program, end_all
from pebble.simulation.loudspeaker import Playback, playbacks
from pebble.simulation.trace import Entry, read_trace
from pebble.transports.segments import sweep

BASE = "pebble/robots/rover"
WIDTH, HEIGHT, FPS = 640, 480, 15  # as the original is configured
CLIP_S = 0.5
_AUDIO_RATE = 16_000
_MCU_START_S = 15.0
_ROBOTS_END_S, _REST_END_S = 6.0, 2.0
_LOG_TAIL = 2000  # characters


class ImpairedRobot:
    """One subject. The local broker and the robot's processes are on its side of the network; the rest is beyond it."""

    def __init__(self, subject: Subject, kind: str, folder: Path) -> None:
        self.subject = subject
        self.operator: Worker | None = None
        self.launcher: Program | None = None
        self.programs: list[Program] = []
        self._folder = folder
        self._folder.mkdir()
        self._trace, self._played = folder / "trace.jsonl", folder / "played"
        self.network: ImpairedNetwork = open_network(kind, name=subject.name)
        self._port, self._local_port = free_port(), free_port()

    def start(self) -> None:
        """Starts all processes; the robot is not yet ready. Raises PebbleError."""
        remote = mosquitto_command(self._port, self._folder / "remote", host=self.network.broker_host)
        self._start("remote broker", self.network.on_remote(remote))
        if self.subject.transport == "mqtt":
            self._start(
                "local broker", self.network.on_robot(mosquitto_command(self._local_port, self._folder / "local"))
            )
        port = self._folder / "mcu"
        self._trace.touch()
        simulation = [sys.executable, "-m", "pebble.simulation.mcu", "--kind", "goob"]
        mcu = self._start("MCU", [*simulation, "--link", str(port), "--trace", str(self._trace)])
        mcu.wait_until(port.exists, _MCU_START_S, threading.Event())
        config = self._folder / "robot.json"
        config.write_text(json.dumps(self._config(port), indent=1))
        command = [sys.executable, "-m", "pebble.cli", "up", str(config)]
        self.launcher = Program(f"robot of {self.subject.name}", self.network.on_robot(command), self._log("robot"))
        operator = [
            sys.executable,
            "-m",
            "pebble.bench.impair.operator",
            self.network.broker_host,
            str(self._port),
            BASE,
        ]
        name = f"the operator of {self.subject.name}"
        self.operator = Worker(name, self.network.on_remote(operator), self._log("operator"))

    def send(self, request: TrialRequest | RecoveryRequest) -> None:
        if self.operator is not None:
            with suppress(BrokenPipeError):  # it has ended: its last report contains the reason
                self.operator.send(msgspec.json.encode(request).decode())

    def next_report(self, timeout: float) -> OperatorReport:
        """The operator's next report. Raises PebbleError for a problem, a timeout, or if a process has ended."""
        if self.operator is None:
            raise PebbleError(f"{self.subject.name} was not started")
        try:
            report = msgspec.convert(self.operator.answer(timeout), OperatorReport)
        except PebbleError as error:
            report = OperatorReport(problem=str(error))
        if ended := next((each for each in (*self.programs, self.launcher) if each is not None and each.ended), None):
            raise PebbleError(f"{ended.name} has ended\n{_tail(ended.log)}".rstrip())
        if report.problem is not None:
            raise PebbleError(f"{self.subject.name}: {report.problem}\n{_tail(self._log('robot'))}".rstrip())
        return report

    def entries(self, since_ns: int) -> list[Entry]:
        """What the MCU received and did after ``since_ns``."""
        return [entry for entry in read_trace(self._trace) if entry.ns >= since_ns]

    def playbacks(self) -> list[Playback]:
        """All clips that the loudspeaker has played."""
        return playbacks(self._played)

    def _start(self, name: str, command: Sequence[str]) -> Program:
        program = Program(f"{name} of {self.subject.name}", command, self._log(name.replace(" ", "-")))
        self.programs.append(program)
        return program

    def _log(self, name: str) -> Path:
        return self._folder / f"{name}.log"

    def _config(self, port: Path) -> dict[str, Any]:
        """The robot's config, with the original's keys and values where it has them."""
        host, remote_port = self.network.broker_address(self._port)
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
        loudspeaker = [sys.executable, "-m", "pebble.simulation.loudspeaker", "--record", str(self._played)]
        playback = {"directory": str(_write_clip(self._folder / "sounds")), "player_command": loudspeaker}
        services["soundboard_handler"] = {"enabled": True, "playback": playback}
        folders = {"run_dir": str(self._folder / "run"), "state_dir": str(self._folder / "state")}
        transport = {"kind": self.subject.transport, **folders}
        config: dict[str, Any] = {"robot": {"id": "rover"}, "transport": transport, "services": services}
        if self.subject.transport == "mqtt":
            config["local_mqtt"] = {"host": "127.0.0.1", "port": self._local_port}
        return config


class TestBed:
    """All robots, in a temporary folder."""

    def __init__(self, subjects: Sequence[Subject], kind: str) -> None:
        self.robots: list[ImpairedRobot] = []
        self._subjects, self._kind = subjects, kind
        self._folder = tempfile.TemporaryDirectory(prefix="pbl-")

    def __enter__(self) -> Self:
        """Starts everything; the robots are not yet ready. Raises PebbleError."""
        try:
            for number, subject in enumerate(self._subjects):
                self.robots.append(ImpairedRobot(subject, self._kind, Path(self._folder.name) / str(number)))
            for robot in self.robots:
                robot.start()
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        """Ends robots before the brokers, which receive their last messages; networks come last."""
        end_workers(robot.operator for robot in self.robots if robot.operator is not None)
        end_all((robot.launcher for robot in self.robots if robot.launcher is not None), _ROBOTS_END_S)
        end_all((program for robot in self.robots for program in robot.programs), _REST_END_S)
        for robot in self.robots:
            robot.network.close()
        self._folder.cleanup()
        sweep()

    def end_trials(self) -> None:
        """Stops all operators."""
        for robot in self.robots:
            if robot.operator is not None:
                robot.operator.close_input()


def _write_clip(folder: Path) -> Path:
    """The folder, with the clip that is played at the end of each trial."""
    folder.mkdir()
    samples = Speech(_AUDIO_RATE).samples(0, round(CLIP_S * _AUDIO_RATE))
    with wave.open(str(folder / CLIP), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(_AUDIO_RATE)
        file.writeframes(to_bytes(samples))
    return folder


def _tail(log: Path) -> str:
    return log.read_text(errors="replace")[-_LOG_TAIL:] if log.exists() else ""
