"""One robot of the demo: its config with other ports and paths, its simulated MCU, and its real launcher."""

from __future__ import annotations

import json
import sys
import threading
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
_LINES = 5_000  # minutes of commands


class SimulatedRobot:
    """A robot on this machine. ``looks`` and ``lines()`` are what its MCU saw: the truth that nobody can talk away."""

    def __init__(self, name: str, folder: Path, local_port: int, remote_port: int) -> None:
        self.name, self._folder = name, folder / name
        self._folder.mkdir()
        self.looks: deque[Look] = deque(maxlen=_LOOKS)
        self._port = self._folder / "mcu"
        self._trace = self._folder / "trace.jsonl"
        self._trace_read = 0
        self._lines: deque[Entry] = deque(maxlen=_LINES)
        self._config = self._folder / f"{name}.json"
        self._config.write_text(json.dumps(self._relocated(local_port, remote_port), indent=2))
        self.mcu: Program | None = None
        self.launcher: Program | None = None

    def start(self, ending: threading.Event) -> None:
        """First the MCU, so that its port exists, then the robot; raises PebbleError if the MCU does not come up."""
        log = self._folder / "mcu.log"
        self.mcu = Program(f"{self.name}'s MCU", self._mcu_command(), log, reports=True)
        self.mcu.wait_until(self._port.exists, _MCU_START_S, ending)
        threading.Thread(target=self._watch, args=(self.mcu,), name=f"looks {self.name}", daemon=True).start()
        command = [sys.executable, "-m", "pebble.cli", "up", str(self._config)]
        self.launcher = Program(self.name, command, self._folder / "robot.log")

    def lines(self) -> list[Entry]:
        """What the host sent to the MCU lately, oldest first."""
        with self._trace.open("rb") as file:
            file.seek(self._trace_read)
            new = file.read()
        complete = new[: new.rfind(b"\n") + 1]
        self._trace_read += len(complete)
        self._lines.extend(msgspec.json.decode(line, type=Entry) for line in complete.splitlines())
        return list(self._lines)

    def _watch(self, mcu: Program) -> None:
        for line in mcu.reports:
            self.looks.append(msgspec.json.decode(line, type=Look))

    def _mcu_command(self) -> list[str]:
        module = [sys.executable, "-m", "pebble.simulation.mcu"]
        return [*module, "--kind", self.name, "--link", str(self._port), "--trace", str(self._trace), "--report"]

    def _relocated(self, local_port: int, remote_port: int) -> dict[str, Any]:
        """The robot's own config file, with nothing changed but where things are."""
        text = (files("pebble") / "configs" / f"{self.name}.json").read_text()
        config: dict[str, Any] = json.loads(text)
        config.setdefault("transport", {})["run_dir"] = str(self._folder / "run")
        config["local_mqtt"] = {"host": "127.0.0.1", "port": local_port}
        services = config["services"]
        services["mqtt_bridge"]["remote_mqtt"] = {"host": "127.0.0.1", "port": remote_port}
        services["serial_mcu_bridge"]["serial"]["port"] = str(self._port)
        services["av_daemon"] = {
            "enabled": True,
            "video": {"backend": "synthetic", "width": 640, "height": 480, "fps": CAMERA_FPS},
            "audio": {"source": "synthetic"},
        }
        return config
