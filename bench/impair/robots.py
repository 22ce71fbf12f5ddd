"""The robots of the trials, as processes: each with its own broker, operator, impaired network and simulated MCU."""

from __future__ import annotations

import sys
import wave
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from pebble.bench.impair.metrics import OperatorReport, RecoveryRequest, TrialRequest
from pebble.bench.impair.network import ImpairedNetwork, open_network
from pebble.bench.impair.operator import CLIP
from pebble.errors import PebbleError
from pebble.media.pcm import to_bytes
from pebble.media.speech import Speech
from pebble.rig.processes import Processes
from pebble.rig.programs import Program
from pebble.rig.robot import BASE, Config, Robot
from pebble.rig.worker import Worker
from pebble.simulation.loudspeaker import Playback, playbacks
from pebble.simulation.trace import Entry
from pebble.transports.segments import sweep

WIDTH, HEIGHT, FPS = 640, 480, 15  # as the original is configured
CLIP_S = 0.5
_AUDIO_RATE = 16_000


@dataclass(frozen=True, slots=True)
class Subject:
    """One robot under test. Encodings are requested by the operator; None: as the robot is configured."""

    name: str
    transport: str  # inside the robot: "mqtt" or "zenoh"
    video: str | None = None
    audio: str | None = None

    @property
    def form(self) -> str:
        """Its encodings: the second part of its name."""
        return self.name.partition(" ")[2]


#: The robots are configured with the original's settings: JSON pictures and PCM.
SUBJECTS = (
    Subject("mqtt original", "mqtt"),
    Subject("zenoh original", "zenoh"),
    Subject("mqtt h264 opus", "mqtt", "h264", "opus"),
    Subject("zenoh h264 opus", "zenoh", "h264", "opus"),
)


class ImpairedRobot:
    """One subject. The local broker and the robot's processes are on its side of the network; the rest is beyond it."""

    def __init__(self, subject: Subject, kind: str, processes: Processes, folder: Path) -> None:
        self.subject = subject
        self.operator: Worker | None = None
        self.programs: list[Program] = []
        self.network: ImpairedNetwork = open_network(kind, name=subject.name)
        self._robot: Robot | None = None
        self._processes, self._folder, self._played = processes, folder, folder / "played"
        self._folder.mkdir()

    def start(self) -> None:
        """Starts all processes; the robot is not yet ready. Raises PebbleError."""
        host, beyond = self.network.broker_host, self.network.on_remote
        remote = self._processes.broker("remote broker", folder=self._folder, host=host, wrap=beyond)
        robot = self._robot = Robot(
            self._processes,
            self.subject.transport,
            self.network.broker_address(remote.port),
            folder=self._folder,
            services=self._services(),
            reports=None,
            wrap=self.network.on_robot,
        )
        robot.prepare()
        robot.launch()
        self.programs += [remote, *robot.programs]
        name = f"the operator of {self.subject.name}"
        self.operator = self._processes.worker(
            name, "pebble.bench.impair.operator", host, remote.port, BASE, wrap=beyond
        )

    def send(self, request: TrialRequest | RecoveryRequest) -> None:
        if self.operator is not None:
            self.operator.send(msgspec.json.encode(request).decode())

    def next_report(self, timeout: float) -> OperatorReport:
        """The operator's next report. Raises PebbleError for a problem, a timeout, or if a process has ended."""
        if self.operator is None:
            raise PebbleError(f"{self.subject.name} was not started")
        try:
            report = msgspec.convert(self.operator.answer(timeout), OperatorReport)
        except PebbleError as error:
            report = OperatorReport(problem=str(error))
        if ended := next((each for each in self.programs if each.ended), None):
            raise PebbleError(f"{self.subject.name}: {ended.name} has ended\n{ended.tail()}".rstrip())
        if report.problem is not None:
            log = "" if self._robot is None else self._robot.log()
            raise PebbleError(f"{self.subject.name}: {report.problem}\n{log}".rstrip())
        return report

    def entries(self, since_ns: int) -> list[Entry]:
        """What the MCU received and did after ``since_ns``."""
        return [] if self._robot is None else self._robot.lines(since_ns)

    def playbacks(self) -> list[Playback]:
        """All clips that the loudspeaker has played."""
        return playbacks(self._played)

    def _services(self) -> dict[str, Config]:
        """The original's keys and values where it has them."""
        video = {"publish_width": WIDTH, "publish_height": HEIGHT, "publish_fps": FPS, "keyframe_interval": 5}
        audio: dict[str, Any] = {"rate": _AUDIO_RATE, "channels": 1}
        loudspeaker = [sys.executable, "-m", "pebble.simulation.loudspeaker", "--record", str(self._played)]
        sounds = _write_clip(self._folder / "sounds")
        publishers = {"video_publisher": {**video, "jpeg_quality": 10}, "audio_publisher": {**audio, "chunk_ms": 20}}
        return {
            "mqtt_bridge": {"media": publishers},
            "av_daemon": {
                "video": {"backend": "synthetic", "width": WIDTH, "height": HEIGHT, "fps": FPS},
                "audio": {"source": "synthetic", **audio},
            },
            "soundboard_handler": {"playback": {"directory": str(sounds), "player_command": loudspeaker}},
        }


class TestBed(Processes):
    """All robots; they are not yet ready when the ``with`` block begins."""

    def __init__(self, subjects: Sequence[Subject], kind: str) -> None:
        super().__init__()
        self.robots: list[ImpairedRobot] = []
        self._subjects, self._kind = subjects, kind

    def start(self) -> None:
        """Raises PebbleError if something does not start."""
        for number, subject in enumerate(self._subjects):
            self.robots.append(ImpairedRobot(subject, self._kind, self, self.folder / str(number)))
        for robot in self.robots:
            robot.start()

    def __exit__(self, *_: object) -> None:
        super().__exit__()
        for robot in self.robots:
            robot.network.close()
        sweep()

    def end_trials(self) -> None:
        """Stops all operators."""
        for operator in self.workers:
            operator.ask_to_end()


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
