"""The files of a robot in virtual time."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

from pebble.config import Config, load


class Folder:
    """The files of a robot with one motor owner, and its parsed config; worlds one after the other share them."""

    def __init__(self) -> None:
        self._temporary = tempfile.TemporaryDirectory(prefix="pbl")
        folder = Path(self._temporary.name)
        transport = {"kind": "mqtt", "state_dir": str(folder / "state"), "run_dir": str(folder / "run")}
        services = {"serial_mcu_bridge": {"enabled": True, "serial": {"port": str(folder / "tty")}}}
        raw = {"robot": {"id": "goob"}, "transport": transport, "local_mqtt": {"host": "127.0.0.1"}}
        path = folder / "robot.json"
        path.write_text(json.dumps({**raw, "services": services}))
        self.configs: list[Config] = [load(path)]
