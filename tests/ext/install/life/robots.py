"""A simulated Goob on a machine of tests/kit: its board on a pty, its broker, and what is heard there."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tests.kit.machine import Machine
from tests.robot.rig import Motors
from tests.support import until

ROBOT = "rover"
BASE = f"pebble/robots/{ROBOT}"
PORT, TRACE = "/run/board/tty", "/var/lib/board/trace"
FOLDERS = ("-p", "RuntimeDirectory=board", "-p", "StateDirectory=board")
CONFIG: dict[str, Any] = {
    "robot": {"id": ROBOT},
    "transport": {"kind": "zenoh"},
    "services": {
        "mqtt_bridge": {"enabled": True, "remote_mqtt": {"host": "127.0.0.1"}},
        "serial_mcu_bridge": {"enabled": True, "serial": {"port": PORT, "baud": 460800}},
        "av_daemon": {
            "enabled": True,
            "video": {"backend": "synthetic", "width": 320, "height": 240, "fps": 15},
            "audio": {"source": "synthetic"},
        },
    },
}


class Robot:
    """What its machine's broker receives of it."""

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        self.board = Motors(Path(PORT), machine.disk / f"upper{TRACE}")

    def plug_in(self) -> None:
        """Start the board; its port is the robot's user's, as a serial port is group dialout's."""
        unit = ("--unit=board", "--uid=pebble", "--gid=pebble", *FOLDERS)
        board = ("sim", "goob", "--link", PORT, "--trace", TRACE)
        self.machine.run("systemd-run", "--quiet", *unit, "--", "/opt/pebble/a/bin/pebble", *board)
        assert until(lambda: self.machine.succeeds("test", "-e", PORT), step=0.1)

    def configure(self, config: dict[str, Any] = CONFIG) -> None:
        """Write its config as ``pebble setup`` leaves it: readable by the robot's group."""
        self.machine.write("/etc/pebble/robot.json", json.dumps(config))
        self.machine.sh("chown root:pebble /etc/pebble/robot.json; chmod 640 /etc/pebble/robot.json")

    def start(self) -> None:
        """Enable the unit; returns when its heartbeat arrives."""
        self.machine.run("systemctl", "enable", "--now", "pebble.service")
        assert self.receives("outgoing/online"), self.machine.journal("pebble.service")

    def send(self, topic: str, body: Any, *options: str) -> None:
        message = json.dumps(body)
        self.machine.run("mosquitto_pub", "-h", "127.0.0.1", "-t", f"{BASE}/{topic}", "-m", message, *options)

    def receives(self, topic: str, count: int = 5, timeout: int = 90) -> bool:
        """Whether that many messages arrive that are not retained: a will is one at most."""
        words = ("mosquitto_sub", "-h", "127.0.0.1", "-R", "-t", f"{BASE}/{topic}")
        return self.machine.succeeds(*words, "-C", str(count), "-W", str(timeout))

    def runs_from(self) -> str:
        """The slot whose Python its main process is."""
        pid = self.machine.run("systemctl", "show", "--value", "--property=MainPID", "pebble.service").strip()
        command = self.machine.run("cat", f"/proc/{pid}/cmdline").split("\0")
        return self.machine.run("readlink", "-f", command[1]).strip().removeprefix("/opt/pebble/")[:1]
