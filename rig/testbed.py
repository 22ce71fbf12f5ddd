"""Brokers, the simulated robots that come with Pebble, their room, and the operator page; Stage has no driver."""

from __future__ import annotations

import json
import math
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from pebble.config.raw import deep_merge
from pebble.contract.identity import Identity
from pebble.errors import PebbleError
from pebble.media.sound_file import write_wav
from pebble.media.world.world_file import read_world
from pebble.rig.acts import CLIP, TAG_ID
from pebble.rig.broker import BrokerKind
from pebble.rig.operator import Operator
from pebble.rig.processes import MCUS, OPERATORS, Processes, python
from pebble.rig.programs import Program
from pebble.rig.robot import MCU_START_S, MEDIA, Robot, SimulatedRobot, board
from pebble.simulation.loudspeaker import playbacks
from pebble.simulation.mcu import Snapshot
from pebble.simulation.motion import Pose
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
_DRIVABLE_S = 30.0
_LONGEST_FOLDER = 40  # characters: Unix sockets live below, and their paths end at 108 bytes
_RESTART = ["sh", "-c", "kill $PPID"]  # the bridge alone, which runs it: the demo would take more for a failure
_AT_REST = (0.0, 0.0)

CLIP_S = 1.0
#: Further clips: the tones of each in Hz, and how long one lasts.
_SIGNALS = {
    "signals/beep.wav": ((880.0,), 0.15),
    "signals/fanfare.wav": ((392.0, 523.3, 659.3, 784.0), 0.2),
    "signals/two-tone.wav": ((440.0, 587.3) * 3, 0.4),
}
_RATE = 16_000
#: After the first round of driving Goob looks at the tag, and has space for further rounds wherever it is then.
_START = {"goob": {"kind": "goob", "x": -0.3, "y": 0.2, "heading_deg": 0.0}}


# -- the robots


class LinuxRobot(Robot):
    """Goob or Fred: the real launcher and services; camera, microphone, MCUs and loudspeaker are simulated."""

    runs_on = "Linux, SAMD21"
    stop_s = 0.85  # 0.75 s watchdog, and its resolution
    has_media = True

    def __init__(self, running: Processes, name: str, local_port: int, remote_port: int, *devices: str) -> None:
        """``devices``: self-describing MCUs that it has besides, by their kind."""
        own = json.loads((files("pebble") / "configs" / f"{name}.json").read_text())
        folder = running.folder / name
        super().__init__(running, own["transport"]["kind"], (_HOST, remote_port), name=name, folder=folder)
        self.has_imu = IMU in devices
        self.local_port = local_port
        self.voice = folder / "voice"  # where its loudspeaker records what it plays of operators' voices
        self._devices = {kind: folder / kind for kind in devices}  # their serial ports
        self._own = own | {"services": own["services"] | {"av_daemon": {}}}
        raw = ["-t", "raw", "-f", "S16_LE", "-c", "{channels}", "-r", "{rate}", "-"]
        instances = {
            _LINES[kind]: {"protocol": "pebble_serial_v1", "serial": {"port": str(port)}}
            for kind, port in self._devices.items()
        }
        self._services = {
            "mqtt_bridge": {
                "service_restart_control": {"command": _RESTART},
                "media": {"audio_receiver": {"command": [*_loudspeaker(self.voice), *raw]}},
            },
            "serial_mcu_bridge": {"instances": instances},
            "av_daemon": MEDIA["av_daemon"],
        }

    def bring_up(self, ending: threading.Event) -> None:
        """Start the MCUs first, so that their ports exist, then the robot."""
        self.prepare(ending)
        starting = []
        for kind, port in self._devices.items():
            options = (*board(kind, port, self.folder / f"{kind}.jsonl"), *_OPTIONS.get(kind, ()))
            command = python("pebble.simulation.mcu", *options)
            starting.append((self._add(f"{self.name}'s {kind}", command, MCUS, f"{kind}.log"), port))
        for program, port in starting:
            program.wait_until(port.exists, MCU_START_S, ending)
        self.start(self.name, python("pebble.cli", "up", self.config))

    def _start_motors(self) -> Program:
        return self._start_mcu("pebble.simulation.mcu", *board(self.name, self.port, self._trace))


@dataclass(frozen=True, slots=True)
class Outcome:
    """The true state at the end, known to the world and the loudspeaker."""

    distance_m: float  # between camera and tag
    bearing_rad: float  # of the tag, positive to the left
    played_s: float
    clip_s: float


class RoomRobot(LinuxRobot):
    """Goob: its MCU is part of a simulated room, its camera sees the room, and a simulated loudspeaker records.

    The room is the one that comes with Pebble, with a tag on each wall and Goob alone in it.
    """

    has_scripts, has_counter = True, False

    def __init__(self, running: Processes, name: str, local_port: int, remote_port: int, *devices: str) -> None:
        super().__init__(running, name, local_port, remote_port, *devices)
        self._room, self._record = self.folder / "room.json", self.folder / "played"
        self.port, self._trace = port_path(self.folder, name), trace_path(self.folder, name)
        room = json.loads((files("pebble.simulation.world") / "room.json").read_text())
        self._room.write_text(json.dumps(room | {"robots": _START}, indent=1))
        sounds = self.folder / "sounds"
        self._clip = _write_clips(sounds)
        playback = {"directory": str(sounds), "player_command": _loudspeaker(self._record)}
        self._services |= {
            "av_daemon": deep_merge(MEDIA["av_daemon"], {"video": {"device": f"{self._room}#{name}"}}),
            "soundboard_handler": {"playback": playback},
        }

    def outcome(self, at: float) -> Outcome:
        """Where the tag was then, and what the loudspeaker has played of the clip."""
        unknown = Pose(math.nan, math.nan)
        pose = next((one.board.pose for one in reversed(self.mcu_reports) if one.ns <= at * 1e9), unknown)
        tag = next(tag for tag in read_world(self._room).tags if tag.id == TAG_ID)
        dx, dy = tag.x - pose.x_mm / 1000, tag.y - pose.y_mm / 1000
        bearing = math.remainder(math.atan2(dy, dx) - pose.heading_rad, math.tau)
        played = [len(one.frames()) for one in playbacks(self._record) if self._clip.startswith(one.frames())]
        return Outcome(math.hypot(dx, dy), bearing, CLIP_S * max(played, default=0) / len(self._clip), CLIP_S)

    def _start_motors(self) -> Program:
        return self._start_mcu("pebble.simulation.world", self._room, "--folder", self.folder, "--trace")

    def _collect(self, line: bytes) -> None:
        seen = msgspec.json.decode(line, type=WorldSnapshot)
        self.mcu_reports.append(Snapshot(seen.ns, True, True, seen.robots[self.name]))


def _loudspeaker(record: Path) -> list[str]:
    return python("pebble.simulation.loudspeaker", "--record", record)


def _write_clips(folder: Path) -> bytes:
    """A horn in ``folder``, which is created, and some signals; returns the samples of the horn."""
    (folder / "signals").mkdir(parents=True)
    horn = _sound(CLIP_S, 440.0, 554.4)
    signals = {name: b"".join(_sound(seconds, tone) for tone in tones) for name, (tones, seconds) in _SIGNALS.items()}
    for name, samples in {**signals, CLIP: horn}.items():
        write_wav(folder / name, samples, _RATE)
    return horn


def _sound(seconds: float, *tones: float) -> bytes:
    phases = 2 * np.pi * np.outer(tones, np.arange(round(seconds * _RATE)) / _RATE)
    return bytes((np.sin(phases).sum(axis=0) * 8000).astype("<i2"))


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


# -- all of them, and the page


class PageServer(Program):
    """A server of the operator page for one broker. Raises PebbleError.

    ``port`` 0 is a free one. ``settings`` are further fields of WebSettings.
    """

    def __init__(self, folder: Path, broker_port: int, port: int = 0, **settings: Any) -> None:
        require_packages()
        self.url = ""  # with a slash at the end; empty until it can be opened
        fields = {"broker": {"host": _HOST, "port": broker_port}, "host": _HOST, "port": port, **settings}
        command = python("pebble.web.program", msgspec.json.encode(fields, enc_hook=str).decode())
        super().__init__("the operator page", command, folder / "page.log", each=self._take)

    def wait(self, ending: threading.Event | None = None) -> None:
        """Wait until the page can be opened at ``url``, or ``ending``. Raises PebbleError if it cannot."""
        self.wait_until(lambda: bool(self.url), _PAGE_START_S, ending)

    def _take(self, line: bytes) -> None:
        self.url = msgspec.json.decode(line, type=Ready).url


class Testbed(Processes):
    """Two brokers, two Linux robots with an MCU each, and two robots that are an MCU; or only those of ``names``.

    ``keep``: the folder with the logs stays after the demo. ``room``: Goob is in a simulated room, and sees it.
    ``broker_port`` is that of the operators' broker, on loopback.
    """

    ends_s = (1.0, 2.5, 1.0, 1.0)  # with the operator's disconnect: every process ends within five seconds

    def __init__(self, ending: threading.Event, names: Sequence[str] = ROBOTS, *, room: bool = True) -> None:
        usual = tempfile.gettempdir()  # mkdtemp makes a 0700 folder in it
        super().__init__("pebble-demo-", usual if len(usual) <= _LONGEST_FOLDER else "/tmp")  # noqa: S108
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

    def start_robots(self) -> None:
        """Raises PebbleError if a simulated MCU fails; the operator detects any other failure."""
        for robot in self.robots.values():
            robot.bring_up(self._ending)


class Stage(Testbed):
    """Brokers and the named robots (none: all four), and the page's server; no operator drives them.

    ``robots``, by name, are traced: ``entries()`` is what each MCU received and did, with time.monotonic_ns().
    ``room``: Goob sees its room, in pictures as old as the room's state; else a scene that is drawn when due.
    ``settings`` are fields of WebSettings. A context manager, for the main thread. Raises PebbleError.
    """

    def __init__(self, *names: str, room: bool = True, **settings: Any) -> None:
        super().__init__(threading.Event(), names or ROBOTS, room=room)
        self.keep, self._settings = False, settings

    def start(self) -> None:
        self.start_brokers()
        self.start_page(**self._settings)
        self.start_robots()
        self.server.wait()
        with closing(Operator(self.broker_port, "stage")) as operator:
            operator.connect()
            operator.wait_until_ready(len(self.robots), _DRIVABLE_S, self.unexpected_exits)

    def __exit__(self, *_: object) -> None:
        if self.page is not None:
            self.page.thaw()
        super().__exit__()

    @property
    def server(self) -> PageServer:
        if self.page is None:
            raise PebbleError("the stage has not been entered")
        return self.page

    @property
    def url(self) -> str:
        """The address of the page, with a slash at the end."""
        return self.server.url

    def restart_server(self) -> None:
        """Start it again at the same address; ends the old one if it runs."""
        port = int(self.url.rpartition(":")[2].rstrip("/"))
        self.start_page(**{**self._settings, "port": port}).wait()

    def ref(self, name: str) -> str:
        return Identity("pebble", "robots", name).base

    def robot_url(self, name: str) -> str:
        return f"{self.url}r/{self.ref(name)}"

    # -- the motors

    def motors(self, name: str) -> list[tuple[int, tuple[float, float]]]:
        """Every change of its motors, oldest first: monotonic ns, left and right."""
        return [(entry.ns, entry.motors) for entry in self.robots[name].entries() if entry.motors is not None]

    def motions(self, name: str) -> list[tuple[int, int]]:
        """From when until when its motors ran at the same speeds; now if they run."""
        changes = self.motors(name)
        ends = [*(ns for ns, _ in changes[1:]), time.monotonic_ns()]
        return [(ns, end) for (ns, speeds), end in zip(changes, ends, strict=False) if speeds != _AT_REST]

    def wheels_turning(self, name: str, since_ns: int | None = None) -> bool:
        """Whether its motors run now; with ``since_ns`` whether they have run at any time since then."""
        since_ns = time.monotonic_ns() if since_ns is None else since_ns
        return self.last_motion_ns(name) > since_ns

    def last_motion_ns(self, name: str) -> int:
        """When its motors were last switched off; now if they run, 0 if they have never run."""
        return max((end for _, end in self.motions(name)), default=0)
