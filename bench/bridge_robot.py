"""A whole simulated robot as processes: brokers, an MCU on a pty, and the real launcher with all its services."""

from __future__ import annotations

import json
import sys
import tempfile
import threading
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from pebble.bench.usage import children
from pebble.contract.identity import Identity
from pebble.rig.broker import Broker, BrokerKind
from pebble.rig.programs import Program, end_all
from pebble.simulation.trace import Entry, read_trace

KINDS = ("mqtt", "zenoh")
STAND_IN = "paho"  # two plain paho programs in place of a robot of ours: see stand_in
_NAME = "rover"
BASE = Identity("pebble", "robots", _NAME).base
_START_S = 15.0
_ROBOT_ENDS_S, _REST_ENDS_S = 6.0, 2.0


class RobotProcesses:
    """``kind`` is the local transport, or STAND_IN. Operators connect to ``remote_port`` of loopback.

    With ``media`` the robot has a camera and a microphone; with ``reports`` it forwards every report of its MCU, 50 a
    second. It starts its own remote broker, unless it is given the port of one.
    """

    def __init__(
        self,
        kind: str,
        *,
        media: bool,
        reports: bool = False,
        launched: bool = True,
        name: str = _NAME,
        remote_port: int | None = None,
    ) -> None:
        """Without ``launched`` only the robot's environment is started; :meth:`launch` starts the robot."""
        self._kind, self._media, self._reports, self._launched = kind, media, reports, launched
        self._name, self._given_port = name, remote_port
        self.base = Identity("pebble", "robots", name).base
        self._folder = tempfile.TemporaryDirectory(prefix="pbl-")
        self._root = Path(self._folder.name)
        self._brokers: dict[str, Broker] = {}
        self._programs: list[Program] = []
        self._launcher: Program | None = None
        self._stand_in: list[Program] = []
        self._never = threading.Event()
        self.run_dir = self._root / "run"

    def __enter__(self) -> Self:
        """Starts everything; the robot is not yet ready. Raises PebbleError if a process does not start."""
        try:
            self._start()
            if self._launched:
                self.launch()
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        """Ends the robot first, while the brokers can still receive its last messages."""
        end_all([*self._stand_in, *([self._launcher] if self._launcher is not None else [])], _ROBOT_ENDS_S)
        end_all([*self._programs, *(broker.program for broker in self._brokers.values())], _REST_ENDS_S)
        self._folder.cleanup()

    @property
    def remote_port(self) -> int:
        return self._brokers["remote"].port if self._given_port is None else self._given_port

    @property
    def broker_ports(self) -> list[int]:
        """The remote broker's port, then that of the local broker, if there is one."""
        return [self.remote_port, *(broker.port for name, broker in self._brokers.items() if name != "remote")]

    def lines(self, since_ns: int) -> list[Entry]:
        """What the MCU received, did and (with ``reports``) sent after ``since_ns`` (CLOCK_MONOTONIC)."""
        return [entry for entry in read_trace(self._root / "trace.jsonl") if entry.ns >= since_ns]

    def pids(self) -> list[int]:
        """The launcher, its children (including a hub), and the local broker, if there is one."""
        local = [self._brokers["local"].program.pid] if "local" in self._brokers else []
        if self._stand_in:
            return [*(one.pid for one in self._stand_in), *local]
        return [] if self._launcher is None else [self._launcher.pid, *children(self._launcher.pid), *local]

    def log(self) -> str:
        """The end of the robot's log."""
        path = self._root / "robot.log"
        return path.read_text(errors="replace")[-2000:] if path.exists() else ""

    def launch(self) -> None:
        """Starts the robot."""
        if self._kind == STAND_IN:
            ports = ["--local", str(self._brokers["local"].port), "--remote", str(self.remote_port)]
            rest = ["--base", self.base, "--device", str(self._root / "mcu")]
            for part in ("bridge", "serial"):
                command = [sys.executable, "-m", "pebble.bench.stand_in", part, *ports, *rest]
                self._stand_in.append(Program(f"the stand-in's {part}", command, self._root / "robot.log"))
            return
        command = [sys.executable, "-m", "pebble.cli", "up", str(self._root / "robot.json")]
        self._launcher = Program(f"the {self._kind} robot", command, self._root / "robot.log")

    def _start(self) -> None:
        wanted = {"remote": self._given_port is None, "local": self._kind in ("mqtt", STAND_IN)}
        for name in (name for name, needed in wanted.items() if needed):
            self._brokers[name] = Broker(name, BrokerKind.MOSQUITTO, self._root)
        for broker in self._brokers.values():
            broker.wait(self._never)
        port, trace = self._root / "mcu", self._root / "trace.jsonl"
        trace.touch()
        simulation = [sys.executable, "-m", "pebble.simulation.mcu", "--kind", "goob", "--link", str(port)]
        simulation += ["--trace", str(trace), *(["--trace-said"] if self._reports else [])]
        mcu = Program("MCU", simulation, self._root / "mcu.log")
        self._programs.append(mcu)
        mcu.wait_until(port.exists, _START_S, self._never)
        (self._root / "robot.json").write_text(json.dumps(self._config(port), indent=1))

    def _config(self, port: Path) -> dict[str, Any]:
        services: dict[str, Any] = {
            "mqtt_bridge": {
                "enabled": True,
                "remote_mqtt": {"host": "127.0.0.1", "port": self.remote_port},
                "media": {"video_publisher": {"publish_width": 640, "publish_height": 360, "publish_fps": 15}},
            },
            "serial_mcu_bridge": {
                "enabled": True,
                "serial": {"port": str(port), "baud": 460800},
                "telemetry": {"publish_touch_sensors": self._reports},
            },
        }
        if self._media:
            services["av_daemon"] = {
                "enabled": True,
                "video": {"backend": "synthetic", "width": 1920, "height": 1080, "fps": 30},
                "audio": {"source": "synthetic"},
            }
        transport: dict[str, Any] = {"kind": self._kind, "run_dir": str(self.run_dir), "state_dir": str(self.run_dir)}
        config: dict[str, Any] = {"robot": {"id": self._name}, "transport": transport, "services": services}
        if "local" in self._brokers:
            config["local_mqtt"] = {"host": "localhost", "port": self._brokers["local"].port}
        return config
