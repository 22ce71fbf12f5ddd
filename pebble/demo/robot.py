"""The robots of the demo: a Linux robot with its launcher and its simulated motor MCU, or an MCU that is the robot."""

from __future__ import annotations

import json
import sys
import threading
from abc import ABC, abstractmethod
from collections import deque
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgspec

from pebble.demo.programs import Program
from pebble.simulation.mcu import Look
from pebble.simulation.trace import Entry

CAMERA_FPS = 15
_MCU_START_S = 10.0
_LOOKS = 600  # a minute of reports
_ENTRIES = 5_000  # minutes of commands


class SimulatedRobot(ABC):
    """A robot on this machine. ``looks`` and ``entries()`` are what its MCU saw and did: nobody can talk that away.

    ``stop_s`` is how long its wheels may turn after the last command, its own watchdog included.
    """

    runs_on: str
    stop_s: float
    has_media = has_imu = False

    def __init__(self, name: str, folder: Path) -> None:
        self.name, self._folder = name, folder / name
        self._folder.mkdir()
        self.looks: deque[Look] = deque(maxlen=_LOOKS)
        self.mcu: Program | None = None
        self.imu: Program | None = None
        self.launcher: Program | None = None
        self._trace = self._folder / "trace.jsonl"
        self._trace_read = 0
        self._entries: deque[Entry] = deque(maxlen=_ENTRIES)

    @abstractmethod
    def start(self, ending: threading.Event) -> None:
        """Raises PebbleError if its MCU does not come up; a robot that fails later is seen by the operator."""

    @property
    def programs(self) -> list[Program]:
        """Everything of it that was started."""
        return [program for program in (self.launcher, *self.mcus) if program is not None]

    @property
    def mcus(self) -> list[Program]:
        """They end after everything that talks to them."""
        return [program for program in (self.mcu, self.imu) if program is not None]

    def entries(self) -> list[Entry]:
        """What reached the MCU and what its motors did lately, oldest first."""
        with self._trace.open("rb") as file:
            file.seek(self._trace_read)
            new = file.read()
        complete = new[: new.rfind(b"\n") + 1]
        self._trace_read += len(complete)
        self._entries.extend(msgspec.json.decode(line, type=Entry) for line in complete.splitlines())
        return list(self._entries)

    def _start_mcu(self, module: str, *options: str) -> Program:
        command = [sys.executable, "-m", module, "--kind", self.name, "--trace", str(self._trace), "--report", *options]
        mcu = Program(f"{self.name}'s MCU", command, self._folder / "mcu.log", reports=True)
        threading.Thread(target=self._watch, args=(mcu,), name=f"looks {self.name}", daemon=True).start()
        return mcu

    def _watch(self, mcu: Program) -> None:
        for line in mcu.reports:
            self.looks.append(msgspec.json.decode(line, type=Look))


class LinuxRobot(SimulatedRobot):
    """Goob or Fred: the real launcher and services, with a camera, a microphone and a motor MCU that are simulated."""

    runs_on = "Linux, SAMD21"
    stop_s = 0.85  # 0.75 s watchdog, and its grain
    has_media = True

    def __init__(self, name: str, folder: Path, local_port: int, remote_port: int, *, has_imu: bool = False) -> None:
        super().__init__(name, folder)
        self.has_imu = has_imu
        self._port, self._imu_port = self._folder / "mcu", self._folder / "imu"
        self._config = self._folder / f"{name}.json"
        self._config.write_text(json.dumps(self._relocated(local_port, remote_port), indent=2))

    def start(self, ending: threading.Event) -> None:
        """First the MCU, so that its port exists, then the robot."""
        self.mcu = self._start_mcu("pebble.simulation.mcu", "--link", str(self._port))
        self.mcu.wait_until(self._port.exists, _MCU_START_S, ending)
        if self.has_imu:
            command = [
                sys.executable,
                "-m",
                "pebble.simulation.mcu",
                "--kind",
                "goob_imu",
                "--link",
                str(self._imu_port),
            ]
            self.imu = Program(f"{self.name}'s IMU", command, self._folder / "imu.log")
            self.imu.wait_until(self._imu_port.exists, _MCU_START_S, ending)
        command = [sys.executable, "-m", "pebble.cli", "up", str(self._config)]
        self.launcher = Program(self.name, command, self._folder / "robot.log")

    def _relocated(self, local_port: int, remote_port: int) -> dict[str, Any]:
        """The robot's own config file, with nothing changed but where things are."""
        text = (files("pebble") / "configs" / f"{self.name}.json").read_text()
        config: dict[str, Any] = json.loads(text)
        config.setdefault("transport", {})["run_dir"] = str(self._folder / "run")
        config["local_mqtt"] = {"host": "127.0.0.1", "port": local_port}
        services = config["services"]
        services["mqtt_bridge"]["remote_mqtt"] = {"host": "127.0.0.1", "port": remote_port}
        services["serial_mcu_bridge"]["serial"]["port"] = str(self._port)
        if self.has_imu:
            services["serial_mcu_bridge"]["instances"]["imu"]["serial"]["port"] = str(self._imu_port)
        services["av_daemon"] = {
            "enabled": True,
            "video": {"backend": "synthetic", "width": 640, "height": 480, "fps": CAMERA_FPS},
            "audio": {"source": "synthetic"},
        }
        return config


class McuRobot(SimulatedRobot):
    """MiniLAMP or BenJr: the firmware's own files against simulated pins, and a link of its own to the broker."""

    stop_s = 1.0

    def __init__(self, name: str, folder: Path, runs_on: str, remote_port: int) -> None:
        super().__init__(name, folder)
        self.runs_on, self._broker = runs_on, f"127.0.0.1:{remote_port}"

    def start(self, ending: threading.Event) -> None:
        self.mcu = self._start_mcu("pebble.simulation.networked", "--broker", self._broker)
        self.mcu.wait_until(lambda: bool(self.looks), _MCU_START_S, ending)
