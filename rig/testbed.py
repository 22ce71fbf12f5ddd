"""Brokers and the simulated robots that come with Pebble: where they live, and in which order they start and end."""

from __future__ import annotations

import json
import math
import sys
import tempfile
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgspec

from pebble.rig.broker import BrokerKind
from pebble.rig.page import PageServer
from pebble.rig.processes import MCUS, OPERATORS, Processes, python
from pebble.rig.processes import ROBOTS as ROBOTS_END
from pebble.rig.programs import Program
from pebble.rig.room import CLIP_S, Outcome, Room, write_clip
from pebble.simulation.loudspeaker import playbacks
from pebble.simulation.mcu import Snapshot
from pebble.simulation.motion import Pose
from pebble.simulation.trace import Entry, read_trace
from pebble.simulation.world.program import Snapshot as WorldSnapshot
from pebble.simulation.world.program import port_path, trace_path

ROBOTS = ("goob", "fred", "minilamp", "benjr")
IMU, OUTLETS = "goob_imu", "outlets"
_LINES = {IMU: "imu", OUTLETS: "outlets"}  # instances of the serial bridge
_OPTIONS = {OUTLETS: ("--unreachable", "o4")}
CAMERA_FPS = 15
_MCU_START_S = 10.0
_LONGEST_FOLDER = 40  # characters: Unix sockets live below, and their paths end at 108 bytes
_REPORTS = 600  # a minute of reports
_ENTRIES = 5_000  # minutes of commands
_RESTART = ["sh", "-c", "kill $PPID"]  # the bridge alone, which runs it: the demo would take more for a failure


class SimulatedRobot(ABC):
    """A robot on this machine. ``mcu_reports`` and ``entries()`` are what its MCU measured, independent of telemetry.

    ``stop_s``: how long its wheels may turn after the last command, its own watchdog included.
    """

    runs_on: str
    stop_s: float
    has_media = has_imu = has_scripts = False
    has_counter = True  # its camera shows a scene with a counter in it

    def __init__(self, processes: Processes, name: str) -> None:
        self.name, self._processes, self._folder = name, processes, processes.folder / name
        self._folder.mkdir()
        self.mcu_reports: deque[Snapshot] = deque(maxlen=_REPORTS)
        self.programs: list[Program] = []  # all processes of it that were started
        self.mcu: Program | None = None
        self.launcher: Program | None = None
        self._trace = self._folder / "trace.jsonl"
        self._trace_read = 0
        self._entries: deque[Entry] = deque(maxlen=_ENTRIES)

    @abstractmethod
    def start(self, ending: threading.Event) -> None:
        """Start its processes. Raises PebbleError if its MCU does not start; the operator detects any later failure."""

    def entries(self) -> list[Entry]:
        """The lines that the MCU received and the changes of its motors, oldest first."""
        with self._trace.open("rb") as file:
            file.seek(self._trace_read)
            new = file.read()
        complete = new[: new.rfind(b"\n") + 1]
        self._trace_read += len(complete)
        self._entries.extend(msgspec.json.decode(line, type=Entry) for line in complete.splitlines())
        return list(self._entries)

    def relays(self) -> list[Entry]:
        """The changes of its outlets' relays, oldest first; most robots have none."""
        return []

    def outcome(self, at: float) -> Outcome:
        """What came of a script that ended at ``at``; only a robot with scripts knows."""
        raise NotImplementedError

    def _start_mcu(self, module: str, *options: object) -> Program:
        """Start the MCU of its motors and collect what it reports."""
        command, log = python(module, *options, "--report"), self._folder / "mcu.log"
        self.mcu = self._add(Program(f"{self.name}'s MCU", command, log, reports=True), MCUS)
        threading.Thread(target=self._watch, args=(self.mcu,), name=f"reports of {self.name}", daemon=True).start()
        return self.mcu

    def _traced(self) -> list[object]:
        return ["--kind", self.name, "--trace", self._trace]

    def _add(self, program: Program, kind: int) -> Program:
        self.programs.append(program)
        return self._processes.add(program, kind)

    def _watch(self, mcu: Program) -> None:
        for line in mcu.reports:
            self.mcu_reports.append(self._read(line))

    def _read(self, line: bytes) -> Snapshot:
        return msgspec.json.decode(line, type=Snapshot)


class LinuxRobot(SimulatedRobot):
    """Goob or Fred: the real launcher and services; camera, microphone, MCUs and loudspeaker are simulated."""

    runs_on = "Linux, SAMD21"
    stop_s = 0.85  # 0.75 s watchdog, and its resolution
    has_media = True

    def __init__(self, processes: Processes, name: str, local_port: int, remote_port: int, *devices: str) -> None:
        """``devices``: self-describing MCUs that it has besides, by their kind."""
        super().__init__(processes, name)
        self.has_imu = IMU in devices
        self._port = self._folder / "mcu"
        self._devices = {kind: self._folder / kind for kind in devices}  # their serial ports
        self._config = self._folder / f"{name}.json"
        self._config.write_text(json.dumps(self._relocated(local_port, remote_port), indent=2))

    def start(self, ending: threading.Event) -> None:
        """Start the MCU first, so that its port exists, then the robot."""
        starting = [(self._start_motors(), self._port)]
        starting[0][0].wait_until(self._port.exists, _MCU_START_S, ending)
        for kind, port in self._devices.items():
            where = ["--link", port, "--trace", self._trace_of(kind), *_OPTIONS.get(kind, ())]
            command = python("pebble.simulation.mcu", "--kind", kind, *where)
            device = Program(f"{self.name}'s {kind}", command, self._folder / f"{kind}.log")
            starting.append((self._add(device, MCUS), port))
        for program, port in starting:
            program.wait_until(port.exists, _MCU_START_S, ending)
        up = Program(self.name, python("pebble.cli", "up", self._config), self._folder / "robot.log")
        self.launcher = self._add(up, ROBOTS_END)

    def relays(self) -> list[Entry]:
        """As its station's trace has them."""
        trace = self._trace_of(OUTLETS)
        return [entry for entry in read_trace(trace) if entry.event == "relay"] if OUTLETS in self._devices else []

    def _start_motors(self) -> Program:
        return self._start_mcu("pebble.simulation.mcu", *self._traced(), "--link", self._port)

    def _trace_of(self, device: str) -> Path:
        return self._folder / f"{device}.jsonl"

    def _relocated(self, local_port: int, remote_port: int) -> dict[str, Any]:
        """The robot's own config file, with only addresses and paths changed."""
        text = (files("pebble") / "configs" / f"{self.name}.json").read_text()
        config: dict[str, Any] = json.loads(text)
        folders = {"run_dir": str(self._folder / "run"), "state_dir": str(self._folder / "state")}
        config.setdefault("transport", {}).update(folders)
        config["local_mqtt"] = {"host": "127.0.0.1", "port": local_port}
        services = config["services"]
        services["mqtt_bridge"]["remote_mqtt"] = {"host": "127.0.0.1", "port": remote_port}
        services["mqtt_bridge"]["service_restart_control"] = {"command": _RESTART}
        services["mqtt_bridge"].setdefault("media", {})["audio_receiver"] = {"command": self._loudspeaker()}
        services["serial_mcu_bridge"]["serial"]["port"] = str(self._port)
        for kind, port in self._devices.items():
            lines = services["serial_mcu_bridge"].setdefault("instances", {})
            lines.setdefault(_LINES[kind], {"protocol": "pebble_serial_v1", "serial": {}})["serial"]["port"] = str(port)
        services["av_daemon"] = {
            "enabled": True,
            "video": {"backend": "synthetic", "width": 640, "height": 480, "fps": CAMERA_FPS},
            "audio": {"source": "synthetic"},
        }
        return config

    @property
    def voice(self) -> Path:
        """Where its loudspeaker records what it plays of operators' voices; see pebble.simulation.loudspeaker."""
        return self._folder / "voice"

    def _loudspeaker(self) -> list[str]:
        raw = ["-t", "raw", "-f", "S16_LE", "-c", "{channels}", "-r", "{rate}", "-"]
        return [sys.executable, "-m", "pebble.simulation.loudspeaker", "--record", str(self.voice), *raw]


class RoomRobot(LinuxRobot):
    """Goob: its MCU is part of a simulated room, its camera sees the room, and a simulated loudspeaker records."""

    has_scripts, has_counter = True, False

    def __init__(self, processes: Processes, name: str, local_port: int, remote_port: int) -> None:
        super().__init__(processes, name, local_port, remote_port, IMU, OUTLETS)
        self._room = Room(self._folder)
        self._port, self._trace = port_path(self._folder, name), trace_path(self._folder, name)
        self._clip = write_clip(self._folder / "sounds")
        config = json.loads(self._config.read_text())
        services = config["services"]
        services["serial_mcu_bridge"]["serial"]["port"] = str(self._port)
        services["av_daemon"]["video"]["device"] = f"{self._room.path}#{name}"
        services["soundboard_handler"]["playback"] = self._playback()
        self._config.write_text(json.dumps(config, indent=2))

    def outcome(self, at: float) -> Outcome:
        """Where the tag was then, and what the loudspeaker has played of the clip."""
        pose = next(
            (one.board.pose for one in reversed(self.mcu_reports) if one.ns <= at * 1e9), Pose(math.nan, math.nan)
        )
        distance, bearing = self._room.tag_from(pose.x_mm / 1000, pose.y_mm / 1000, pose.heading_rad)
        played = [len(one.frames()) for one in playbacks(self._record) if self._clip.startswith(one.frames())]
        return Outcome(distance, bearing, CLIP_S * max(played, default=0) / len(self._clip), CLIP_S)

    @property
    def _record(self) -> Path:
        return self._folder / "played"

    def _playback(self) -> dict[str, Any]:
        player = [sys.executable, "-m", "pebble.simulation.loudspeaker", "--record", str(self._record)]
        return {"directory": str(self._folder / "sounds"), "player_command": player}

    def _start_motors(self) -> Program:
        return self._start_mcu("pebble.simulation.world", self._room.path, "--folder", self._folder, "--trace")

    def _read(self, line: bytes) -> Snapshot:
        seen = msgspec.json.decode(line, type=WorldSnapshot)
        return Snapshot(seen.ns, True, True, seen.robots[self.name])


class McuRobot(SimulatedRobot):
    """MiniLAMP or BenJr: the firmware's own files against simulated pins, with its own connection to the broker."""

    stop_s = 1.0

    def __init__(self, processes: Processes, name: str, runs_on: str, remote_port: int) -> None:
        super().__init__(processes, name)
        self.runs_on, self._broker = runs_on, f"127.0.0.1:{remote_port}"

    def start(self, ending: threading.Event) -> None:
        mcu = self._start_mcu("pebble.simulation.networked", *self._traced(), "--broker", self._broker)
        mcu.wait_until(lambda: bool(self.mcu_reports), _MCU_START_S, ending)


class Testbed(Processes):
    """Two brokers, two Linux robots with an MCU each, and two robots that are an MCU; or only those of ``names``.

    ``keep``: the folder with the logs stays after the demo. ``room``: Goob is in a simulated room, and sees it.
    ``broker_port`` is that of the operators' broker, on loopback.
    """

    ends_s = (1.0, 2.5, 1.0, 1.0)  # with the operator's disconnect: every process ends within five seconds

    def __init__(self, ending: threading.Event, names: Sequence[str] = ROBOTS, *, room: bool = True) -> None:
        super().__init__("pebble-demo-", _temporary_folder())
        self.keep = True
        self.robots: dict[str, SimulatedRobot] = {}
        self.page: PageServer | None = None
        self._ending, self._names, self._room = ending, names, room

    def start_brokers(self, kind: BrokerKind = BrokerKind.MOSQUITTO) -> None:
        """Start the operators' remote broker and Fred's local one. Raises PebbleError if one fails."""
        self.remote_broker, local = (self.broker(name, kind) for name in ("remote-broker", "freds-broker"))
        for broker in (self.remote_broker, local):
            broker.wait(self._ending)
        remote = self.broker_port = self.remote_broker.port
        makers: dict[str, Callable[[], SimulatedRobot]] = {
            "goob": partial(RoomRobot, self, "goob", local.port, remote)
            if self._room
            else partial(LinuxRobot, self, "goob", local.port, remote, IMU, OUTLETS),
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
            robot.start(self._ending)


def _temporary_folder() -> str:
    usual = tempfile.gettempdir()
    return usual if len(usual) <= _LONGEST_FOLDER else "/tmp"  # noqa: S108 - mkdtemp makes a 0700 folder in it
