"""Brokers and the simulated robots that come with Pebble: where they live, and in which order they start and end."""

from __future__ import annotations

import json
import math
import tempfile
import threading
from collections.abc import Callable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgspec

from pebble.config.raw import deep_merge
from pebble.rig.broker import BrokerKind
from pebble.rig.processes import MCUS, OPERATORS, Processes, python
from pebble.rig.programs import Program
from pebble.rig.robot import MCU_START_S, MEDIA, Robot, SimulatedRobot, board
from pebble.rig.room import CLIP_S, Outcome, Room, write_clip
from pebble.simulation.loudspeaker import playbacks
from pebble.simulation.mcu import Snapshot
from pebble.simulation.motion import Pose
from pebble.simulation.trace import Entry, read_trace
from pebble.simulation.world.program import Snapshot as WorldSnapshot
from pebble.simulation.world.program import port_path, trace_path
from pebble.web.extra import require_packages
from pebble.web.program import Ready

ROBOTS = ("goob", "fred", "minilamp", "benjr")
IMU, OUTLETS = "goob_imu", "outlets"
_LINES = {IMU: "imu", OUTLETS: "outlets"}  # instances of the serial bridge
_OPTIONS = {OUTLETS: ("--unreachable", "o4")}
CAMERA_FPS: int = MEDIA["av_daemon"]["video"]["fps"]
_HOST = "127.0.0.1"
_PAGE_START_S = 15.0  # it takes a while to import on a small machine
_LONGEST_FOLDER = 40  # characters: Unix sockets live below, and their paths end at 108 bytes
_RESTART = ["sh", "-c", "kill $PPID"]  # the bridge alone, which runs it: the demo would take more for a failure


class LinuxRobot(Robot):
    """Goob or Fred: the real launcher and services; camera, microphone, MCUs and loudspeaker are simulated."""

    runs_on = "Linux, SAMD21"
    stop_s = 0.85  # 0.75 s watchdog, and its resolution
    has_media = True

    def __init__(self, running: Processes, name: str, local_port: int, remote_port: int, *devices: str) -> None:
        """``devices``: self-describing MCUs that it has besides, by their kind."""
        self._own = json.loads((files("pebble") / "configs" / f"{name}.json").read_text())
        kind, folder = self._own["transport"]["kind"], running.folder / name
        super().__init__(running, kind, (_HOST, remote_port), name=name, folder=folder)
        self.has_imu = IMU in devices
        self.local_port = local_port
        self._devices = {kind: folder / kind for kind in devices}  # their serial ports

    def bring_up(self, ending: threading.Event) -> None:
        """Start the MCUs first, so that their ports exist, then the robot."""
        self.prepare(ending)
        starting = []
        for kind, port in self._devices.items():
            options = (*board(kind, port, self._trace_of(kind)), *_OPTIONS.get(kind, ()))
            command = python("pebble.simulation.mcu", *options)
            starting.append((self._add(f"{self.name}'s {kind}", command, MCUS, f"{kind}.log"), port))
        for program, port in starting:
            program.wait_until(port.exists, MCU_START_S, ending)
        self.start(self.name, python("pebble.cli", "up", self.config))

    def relays(self) -> list[Entry]:
        trace = self._trace_of(OUTLETS)
        return [entry for entry in read_trace(trace) if entry.event == "relay"] if OUTLETS in self._devices else []

    @property
    def voice(self) -> Path:
        """Where its loudspeaker records what it plays of operators' voices; see pebble.simulation.loudspeaker."""
        return self.folder / "voice"

    def _start_motors(self) -> Program:
        return self._start_mcu("pebble.simulation.mcu", *board(self.name, self.port, self._trace))

    def _trace_of(self, device: str) -> Path:
        return self.folder / f"{device}.jsonl"

    def _contents(self) -> dict[str, Any]:
        """Its own config file, with only addresses, paths and devices changed."""
        raw = ["-t", "raw", "-f", "S16_LE", "-c", "{channels}", "-r", "{rate}", "-"]
        instances = {
            _LINES[kind]: {"protocol": "pebble_serial_v1", "serial": {"port": str(port)}}
            for kind, port in self._devices.items()
        }
        bridge = {
            "service_restart_control": {"command": _RESTART},
            "media": {"audio_receiver": {"command": [*_loudspeaker(self.voice), *raw]}},
        }
        services = {"mqtt_bridge": bridge, "serial_mcu_bridge": {"instances": instances}}
        config = self._connected(deep_merge(self._own, {"services": services}))
        config["services"]["av_daemon"] = {"enabled": True, **MEDIA["av_daemon"]}
        return config


class RoomRobot(LinuxRobot):
    """Goob: its MCU is part of a simulated room, its camera sees the room, and a simulated loudspeaker records."""

    has_scripts, has_counter = True, False

    def __init__(self, running: Processes, name: str, local_port: int, remote_port: int, *devices: str) -> None:
        super().__init__(running, name, local_port, remote_port, *devices)
        self._room, self._record = Room(self.folder), self.folder / "played"
        self.port, self._trace = port_path(self.folder, name), trace_path(self.folder, name)
        self._clip = write_clip(self.folder / "sounds")

    def outcome(self, at: float) -> Outcome:
        """Where the tag was then, and what the loudspeaker has played of the clip."""
        pose = next(
            (one.board.pose for one in reversed(self.mcu_reports) if one.ns <= at * 1e9), Pose(math.nan, math.nan)
        )
        distance, bearing = self._room.tag_from(pose.x_mm / 1000, pose.y_mm / 1000, pose.heading_rad)
        played = [len(one.frames()) for one in playbacks(self._record) if self._clip.startswith(one.frames())]
        return Outcome(distance, bearing, CLIP_S * max(played, default=0) / len(self._clip), CLIP_S)

    def _contents(self) -> dict[str, Any]:
        playback = {"directory": str(self.folder / "sounds"), "player_command": _loudspeaker(self._record)}
        services = {
            "av_daemon": {"video": {"device": f"{self._room.path}#{self.name}"}},
            "soundboard_handler": {"playback": playback},
        }
        config: dict[str, Any] = deep_merge(super()._contents(), {"services": services})
        return config

    def _start_motors(self) -> Program:
        return self._start_mcu("pebble.simulation.world", self._room.path, "--folder", self.folder, "--trace")

    def _read(self, line: bytes) -> Snapshot:
        seen = msgspec.json.decode(line, type=WorldSnapshot)
        return Snapshot(seen.ns, True, True, seen.robots[self.name])


def _loudspeaker(record: Path) -> list[str]:
    return python("pebble.simulation.loudspeaker", "--record", record)


class McuRobot(SimulatedRobot):
    """MiniLAMP or BenJr: the firmware's own files against simulated pins, with its own connection to the broker."""

    stop_s = 1.0

    def __init__(self, running: Processes, name: str, runs_on: str, remote_port: int) -> None:
        super().__init__(running, name, running.folder / name)
        self.runs_on, self._broker = runs_on, f"{_HOST}:{remote_port}"

    def bring_up(self, ending: threading.Event) -> None:
        options = ("--kind", self.name, "--trace", self._trace, "--broker", self._broker)
        mcu = self._start_mcu("pebble.simulation.networked", *options)
        mcu.wait_until(lambda: bool(self.mcu_reports), MCU_START_S, ending)


class PageServer(Program):
    """A server of the operator page for one broker. Raises PebbleError.

    ``port`` 0 is a free one. ``settings`` are further fields of WebSettings.
    """

    def __init__(self, folder: Path, broker_port: int, port: int = 0, **settings: Any) -> None:
        require_packages()
        self.url = ""
        fields = {"broker": {"host": _HOST, "port": broker_port}, "host": _HOST, "port": port, **settings}
        command = python("pebble.web.program", msgspec.json.encode(fields, enc_hook=str).decode())
        super().__init__("the operator page", command, folder / "page.log", reports=True)
        self._answer: list[bytes] = []
        threading.Thread(target=self._read, name="address of the page", daemon=True).start()

    def wait(self, ending: threading.Event | None = None) -> None:
        """Wait until the page can be opened at ``url``, or ``ending``. Raises PebbleError if it cannot."""
        self.wait_until(lambda: bool(self._answer and self._answer[0]), _PAGE_START_S, ending)
        if self._answer:
            self.url = msgspec.json.decode(self._answer[0], type=Ready).url

    def _read(self) -> None:
        self._answer.append(self.reports.readline())


class Testbed(Processes):
    """Two brokers, two Linux robots with an MCU each, and two robots that are an MCU; or only those of ``names``.

    ``keep``: the folder with the logs stays after the demo. ``room``: Goob is in a simulated room, and sees it.
    ``broker_port`` is that of the operators' broker, on loopback.
    """

    ends_s = (1.0, 2.5, 1.0, 1.0)  # with the operator's disconnect: every process ends within five seconds

    def __init__(self, ending: threading.Event, names: Sequence[str] = ROBOTS, *, room: bool = True) -> None:
        super().__init__("pebble-demo-", _temporary_folder())
        self.keep = True
        self.robots: dict[str, LinuxRobot | McuRobot] = {}
        self.page: PageServer | None = None
        self._ending, self._names, self._room = ending, names, room

    def start_brokers(self, kind: BrokerKind = BrokerKind.MOSQUITTO) -> None:
        """Start the operators' remote broker and Fred's local one. Raises PebbleError if one fails."""
        self.remote_broker, local = (self.broker(name, kind) for name in ("remote-broker", "freds-broker"))
        for broker in (self.remote_broker, local):
            broker.wait(self._ending)
        remote = self.broker_port = self.remote_broker.port
        goob = RoomRobot if self._room else LinuxRobot
        makers: dict[str, Callable[[], LinuxRobot | McuRobot]] = {
            "goob": lambda: goob(self, "goob", local.port, remote, IMU, OUTLETS),
            "fred": lambda: LinuxRobot(self, "fred", local.port, remote),
            "minilamp": lambda: McuRobot(self, "minilamp", "ESP32-C6", remote),
            "benjr": lambda: McuRobot(self, "benjr", "ESP8266", remote),
        }
        self.robots = {name: makers[name]() for name in self._names}

    def start_page(self, port: int = 0, **settings: Any) -> PageServer:
        """Start the operator page's server, and end one that was started before; wait for it. Raises PebbleError."""
        if self.page is not None:
            self.end(self.page)
        self.page = PageServer(self.folder, self.broker_port, port, **{"server": "demo", **settings})
        return self.add(self.page, OPERATORS)

    def restart_broker(self) -> None:
        """Start the operators' broker again at the same port, without its retained messages. Raises PebbleError."""
        self.end(self.remote_broker)
        self.remote_broker = self.broker("remote-broker", port=self.broker_port)
        self.remote_broker.wait(self._ending)

    def start_robots(self) -> None:
        """Raises PebbleError if a simulated MCU fails; the operator detects any other failure."""
        for robot in self.robots.values():
            robot.bring_up(self._ending)


def _temporary_folder() -> str:
    usual = tempfile.gettempdir()
    return usual if len(usual) <= _LONGEST_FOLDER else "/tmp"  # noqa: S108 - mkdtemp makes a 0700 folder in it
