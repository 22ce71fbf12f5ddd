"""A whole robot to be driven: brokers, a simulated MCU on a pty, and the real launcher with all its processes."""

from __future__ import annotations

import json
import sys
import tempfile
import threading
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from pebble.bench.usage import children
from pebble.demo.broker import Broker, BrokerKind
from pebble.demo.programs import Program, end_all
from pebble.simulation.trace import Entry, read_trace

KINDS = ("mqtt", "zenoh")
BASE = "pebble/robots/rover"
_START_S = 15.0
_ROBOT_ENDS_S, _REST_ENDS_S = 6.0, 2.0


class Robot:
    """``kind`` is its own transport: ``mqtt`` or ``zenoh``. Operators reach it at ``remote_port`` of loopback.

    With ``media`` it has a camera and a microphone, with ``reports`` it passes on every report of its MCU, 50 a second.
    """

    def __init__(self, kind: str, *, media: bool, reports: bool = False, launched: bool = True) -> None:
        """Without ``launched`` everything around the robot is started, and it itself by :meth:`launch`."""
        self._kind, self._media, self._reports, self._launched = kind, media, reports, launched
        self._folder = tempfile.TemporaryDirectory(prefix="pbl-")
        self._root = Path(self._folder.name)
        self._brokers: list[Broker] = []
        self._programs: list[Program] = []
        self._launcher: Program | None = None
        self._never = threading.Event()
        self.run_dir = self._root / "run"

    def __enter__(self) -> Self:
        """Start everything; the robot itself is not yet ready. Raises PebbleError if something does not start."""
        try:
            self._start()
            if self._launched:
                self.launch()
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        """The robot first, while those it says its last words to are still there."""
        end_all([self._launcher] if self._launcher is not None else [], _ROBOT_ENDS_S)
        end_all([*self._programs, *(broker.program for broker in self._brokers)], _REST_ENDS_S)
        self._folder.cleanup()

    @property
    def remote_port(self) -> int:
        return self._brokers[0].port

    @property
    def broker_ports(self) -> list[int]:
        """The remote broker's, then that of the broker on the robot, where it has one."""
        return [broker.port for broker in self._brokers]

    def lines(self, since_ns: int) -> list[Entry]:
        """What reached the MCU, what it did and (with ``reports``) said, after ``since_ns`` (CLOCK_MONOTONIC)."""
        return [entry for entry in read_trace(self._root / "trace.jsonl") if entry.ns >= since_ns]

    def pids(self) -> list[int]:
        """The launcher, its children (a hub is one), and the broker on the robot, where it has one."""
        if self._launcher is None:
            return []
        return [self._launcher.pid, *children(self._launcher.pid), *(one.program.pid for one in self._brokers[1:])]

    def log(self) -> str:
        """The end of what the robot said."""
        path = self._root / "robot.log"
        return path.read_text(errors="replace")[-2000:] if path.exists() else ""

    def launch(self) -> None:
        """Start the robot itself."""
        command = [sys.executable, "-m", "pebble.cli", "up", str(self._root / "robot.json")]
        self._launcher = Program(f"the {self._kind} robot", command, self._root / "robot.log")

    def _start(self) -> None:
        for name in ("remote", "local") if self._kind == "mqtt" else ("remote",):
            self._brokers.append(Broker(name, BrokerKind.MOSQUITTO, self._root))
        for broker in self._brokers:
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
        transport: dict[str, Any] = {"kind": self._kind, "run_dir": str(self.run_dir)}
        config: dict[str, Any] = {"robot": {"id": "rover"}, "transport": transport, "services": services}
        if self._kind == "mqtt":
            config["local_mqtt"] = {"host": "localhost", "port": self._brokers[1].port}
        return config
