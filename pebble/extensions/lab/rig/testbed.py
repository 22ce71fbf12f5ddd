"""Brokers, the simulated robots that come with Pebble, their room, and the operator page."""

from __future__ import annotations

import json
import struct
import threading
import time
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgspec

from pebble.config.raw import deep_merge
from pebble.errors import PebbleError
from pebble.extensions.lab.rig.processes import HOST, OPERATORS, Processes, Program, python
from pebble.extensions.lab.rig.robot import MEDIA, START_S, Config, Robot, SimulatedRobot
from pebble.extensions.lab.simulation.world.program import port_path, trace_path
from pebble.extensions.media.sound_file import write_wav
from pebble.extensions.operator.client.discovery import ALL_OUTGOING, Discovery
from pebble.extensions.operator.client.page_packages import require_packages
from pebble.transports import MqttSettings, create

ROBOTS = ("goob", "fred", "minilamp", "benjr")
CLIP = "horn.wav"  # that Goob plays
TAG_ID = 21  # of the tag that Goob follows, as in the world file
_BOARDS = {"minilamp": "ESP32-C6", "benjr": "ESP8266"}
_RESTART = ["sh", "-c", "kill $PPID"]  # the bridge alone, which runs it: the demo would take more for a failure
_RATE = 16_000
_READY_S, _POLL_S = 30.0, 0.02
HORN = struct.pack("<40h", *[8000] * 20, *[-8000] * 20) * 400  # the clip: 1 s of 400 Hz
#: After the first round of driving Goob looks at the tag, with Fred in sight, and both have space for further rounds.
_START = {
    "goob": {"kind": "goob", "x": -0.3, "y": 0.2, "heading_deg": 0.0, "tag": 1},
    "fred": {"kind": "fred", "x": 0.64, "y": -1.86, "heading_deg": 180.0, "tag": 2},
}


class LinuxRobot(Robot):
    """Goob or Fred: the real launcher and services, with simulated camera, microphone, MCUs and loudspeaker.

    Both are in the room that comes with Pebble: their motor MCUs are part of it, and their cameras see it. A simulated
    loudspeaker records the sound that Goob ``played``. ``instances`` are the configs of its self-describing MCUs, to
    which others may be added before it is brought up.
    """

    runs_on = "Linux, SAMD21"
    has_media = True
    running: Testbed

    def __init__(self, running: Testbed, name: str) -> None:
        config = _config(name)
        remote, folder = (HOST, running.broker_port), running.folder / name
        super().__init__(running, config["transport"]["kind"], remote, name=name, folder=folder)
        self.has_scripts = name == "goob"
        self.local_port = running.local_broker.port
        self.port, self._trace = port_path(running.world, name), trace_path(running.world, name)
        self.voice = folder / "voice"  # where its loudspeaker records what it plays of operators' voices
        self.played = folder / "played"
        self._imu = folder / "imu"  # a serial port
        self.instances: dict[str, Config] = {}
        # without its real camera and microphone: below are simulated ones
        self._base_config = config | {"services": config["services"] | {"av_daemon": {}}}
        raw = ["-t", "raw", "-f", "S16_LE", "-c", "{channels}", "-r", "{rate}", "-"]
        camera = {"video": {"device": f"{running.room_file}#{name}"}}
        self._services = {
            "mqtt_bridge": {
                "service_restart_control": {"command": _RESTART},
                "media": {"audio_receiver": {"command": [*_loudspeaker(self.voice), *raw]}},
            },
            "serial_mcu_bridge": {
                "instances": self.instances,
                "telemetry": {"publish_touch_sensors": self.has_scripts},  # the script wheel-odometry reads them
            },
            "av_daemon": deep_merge(MEDIA["av_daemon"], camera),
        }
        if self.has_scripts:
            self.instances["imu"] = {"protocol": "pebble_serial_v1", "serial": {"port": str(self._imu)}}
            self._services |= {"soundboard_handler": {"playback": self._playback()}}

    def _playback(self) -> Config:
        sounds = self.folder / "sounds"
        (sounds / "signals").mkdir(parents=True)
        for clip, seconds in {CLIP: 1.0, "signals/beep.wav": 0.15, "signals/long.wav": 0.6}.items():
            write_wav(sounds / clip, HORN[: 2 * round(seconds * _RATE)], _RATE)
        return {"directory": str(sounds), "player_command": _loudspeaker(self.played)}

    def bring_up(self, ending: threading.Event) -> None:
        """Start the MCUs first, so that their ports exist, then the robot."""
        if "imu" in self.instances:
            mcu = self._start_board("goob_imu", self._imu, self.folder / "imu.jsonl", name="imu")
            mcu.wait_until(self._imu.exists, START_S, ending)
        self.prepare(ending)
        self.start(self.name, python("pebble.cli", "up", self.config))

    def _start_motors(self) -> Program:
        """Return the room's program, which the first robot starts."""
        running = self.running
        if running.room is None:
            folder = running.world
            running.room = self._start_mcu("world", running.room_file, "--folder", folder, "--trace", folder)
        return running.room


def _config(name: str) -> Any:
    return json.loads((files("pebble") / "configs" / f"{name}.json").read_text())


def _loudspeaker(record: Path) -> list[str]:
    return python("pebble.extensions.lab.simulation.loudspeaker", "--record", record)


class McuRobot(SimulatedRobot):
    """MiniLAMP or BenJr: the real firmware files on simulated pins, with its own connection to the broker."""

    def __init__(self, running: Testbed, name: str) -> None:
        super().__init__(running, name, running.folder / name)
        self.runs_on, self._broker = _BOARDS[name], f"mqtt://{HOST}:{running.broker_port}"
        self._called = _config(name)["robot"]["name"]

    def bring_up(self, _ending: threading.Event) -> None:
        self._trace.touch()
        options = ("--name", self._called, "--broker", self._broker, "--trace", self._trace)
        self._start_mcu(self.name, *options)


class PageServer(Program):
    """A server of the operator page for one broker; ``settings`` are more fields of WebSettings."""

    def __init__(self, folder: Path, broker_port: int, **settings: Any) -> None:
        """Start the server. Raises PebbleError without the packages that it needs."""
        require_packages()
        self.url = ""  # with a slash at the end; empty until it can be opened
        fields = {"broker": {"host": HOST, "port": broker_port}, "host": HOST, "server": "demo", **settings}
        command = python("pebble.extensions.lab.rig.page", msgspec.json.encode(fields, enc_hook=str).decode())
        super().__init__("the operator page", command, folder / "page.log", self._note_url)

    def wait(self, ending: threading.Event | None = None) -> None:
        """Wait until the page can be opened at ``url``, or ``ending``. Raises PebbleError if it cannot."""
        self.wait_until(lambda: bool(self.url), START_S, ending)

    def _note_url(self, line: bytes) -> None:
        self.url = line.decode().strip()


class Testbed(Processes):
    """Two brokers, two Linux robots with an MCU each, and two robots that are an MCU; or only those of ``names``.

    ``keep``: the folder with the logs stays after the demo. ``world``: the folder of Goob's and Fred's room.
    ``broker_port``: the operators' broker, on loopback.
    """

    ends_s = (1.0, 2.5, 1.0, 1.0)  # shorter than usual: with the operator's disconnect all end within five seconds
    keep = True
    server: PageServer  # the newest
    room: Program | None = None  # once it runs

    def __init__(self, ending: threading.Event, names: Sequence[str] = ROBOTS) -> None:
        super().__init__("pebble-demo-")
        self.robots: dict[str, LinuxRobot | McuRobot] = {}
        self._ending, self._names = ending, names
        self.world = self.folder / "world"
        self.world.mkdir()
        self.room_file = self.world / "room.json"
        room = json.loads((files("pebble.extensions.lab.simulation.world") / "room.json").read_text())
        self.room_file.write_text(json.dumps(room | {"robots": _START}, indent=1))

    def start_brokers(self, program: str | None = None) -> None:
        """Start the operators' remote broker and Fred's local one, see Broker; make the robots, which use their ports.

        Raises PebbleError if a broker fails.
        """
        broker_names = "remote-broker", "freds-broker"
        self.remote_broker, self.local_broker = (self.broker(name, program=program) for name in broker_names)
        for broker in (self.remote_broker, self.local_broker):
            broker.wait(self._ending)
        self.broker_port = self.remote_broker.port
        for name in self._names:
            self.robots[name] = McuRobot(self, name) if name in _BOARDS else LinuxRobot(self, name)

    def start_page(self, port: int = 0, **settings: Any) -> PageServer:
        """Start the operator page in place of an earlier one; return its server. ``port`` 0: a free port."""
        for earlier in [program for program in self._kinds if isinstance(program, PageServer)]:
            self.end(earlier)
        self.server = self.add(PageServer(self.folder, self.broker_port, port=port, **settings), OPERATORS)
        return self.server

    def start_recorder(self, into: Path, *options: object) -> Program:
        """Start ``pebble record`` for everything at the operators' broker; return it, perhaps not yet ready.

        ``options`` are more arguments of the command.
        """
        url = f"mqtt://{HOST}:{self.broker_port}"
        command = python("pebble.cli", "record", "--url", url, "--into", into, *options)
        return self.add(Program("pebble record", command, self.folder / "record.log"), OPERATORS)

    def start_robots(self) -> None:
        """Start the robots. Raises PebbleError if a simulated MCU fails; any other failure shows at the operator."""
        for robot in self.robots.values():
            robot.bring_up(self._ending)

    def wait_until_ready(self) -> None:
        """Wait until all robots can be driven. Raises PebbleError after half a minute, or if a process ends."""
        discovery, end = Discovery(), time.monotonic() + _READY_S
        with create("mqtt", "testbed", MqttSettings(host=HOST, port=self.broker_port)) as transport:
            transport.subscribe(ALL_OUTGOING, lambda message: discovery.receive(message, time.monotonic(), time.time()))
            while sum(robot.ready(time.monotonic()) for robot in discovery.all_robots()) < len(self.robots):
                if (problems := self.unexpected_exits()) or time.monotonic() > end:
                    raise PebbleError("; ".join(problems) or "the robots did not become ready to drive")
                time.sleep(_POLL_S)
