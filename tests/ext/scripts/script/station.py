"""A robot's local transport with a stand-in for its motor owner, and scripts as real processes on it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

from pebble.config import LAUNCHER_LOCK, load
from pebble.contract import DRIVE, ESTOP_STATE, codec
from pebble.contract.payloads import Drive
from pebble.runtime.connections import local_transport
from pebble.transports import Message, QoS
from tests.ext.operator.client.estop_robot import estop_state
from tests.support import WAIT_S, Broker, Child, until
from tests.transports.zenoh_net import HubProcess


class Received(NamedTuple):
    at: float  # monotonic
    drive: Drive


class Station:
    """Broker or hub, the robot's config, what its motor owner receives, and the scripts that are running."""

    def __init__(self, kind: str) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="pbl")  # pytest's own may be too long for a socket
        self.folder = Path(self._folder.name)
        self.broker = Broker(self.folder) if kind == "mqtt" else None
        (self.folder / "run").mkdir(mode=0o700)
        (self.folder / "run" / LAUNCHER_LOCK).write_text(f"{os.getpid()}\n")
        self.hub = HubProcess(self.folder / "run").start() if kind == "zenoh" else None
        self.config_path = self.folder / "goob.json"
        port = 1883 if self.broker is None else self.broker.port
        self.config_path.write_text(json.dumps({
            "robot": {"id": "goob"},
            "local_mqtt": {"host": "127.0.0.1", "port": port},
            "transport": {"kind": kind, "run_dir": str(self.folder / "run")},
            "services": {"neighbours": {"enabled": True, "listens": {"fred": ["wheel-odometry"]},
                                        "lan": {"connect": ["tcp/127.0.0.1:7447"]}}},
        }))  # fmt: skip
        self.config = load(self.config_path)
        self.received: list[Received] = []
        self._scripts: list[subprocess.Popen[str]] = []
        self.transport = local_transport(self.config, "owner")
        self.transport.open(WAIT_S)
        self.transport.subscribe(DRIVE.topic(self.config.base), self._receive)
        self.publish_state()

    def start(self, body: str, *options: str, run: int | None = None) -> subprocess.Popen[str]:
        """Start a script whose ``main(robot)`` is these lines; its output is one pipe."""
        path = self.folder / f"script{len(self._scripts)}.py"
        lines = "\n".join(f"    {line}" for line in body.splitlines())
        before, after = "import os, sys, time\nfrom pebble import Robot, run\n\n", "\n\nrun(main)\n"
        path.write_text(f"{before}def main(robot: Robot) -> None:\n{lines}{after}")
        return self.start_file(path, *options, run=run)

    def start_file(self, path: Path, *options: str, run: int | None = None) -> subprocess.Popen[str]:
        """Start this program with the robot's config; ``run`` as the manager gives it."""
        env = os.environ if run is None else {**os.environ, "PEBBLE_RUN": str(run)}
        command = [sys.executable, str(path), "--config", str(self.config_path), *options]
        script = Child(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=env)
        self._scripts.append(script)
        return script

    def driven(self, body: str, **options: Any) -> subprocess.Popen[str]:
        """Start it, and wait until it drives."""
        before = len(self.received)
        script = self.start(body, **options)
        assert until(lambda: self.moves(before)), script.communicate(timeout=WAIT_S)[0]
        return script

    def moves(self, since: int = 0) -> bool:
        """Whether the newest of the commands after the first ``since`` moves the robot."""
        commands = self.received[since:]
        return bool(commands) and commands[-1].drive.moves

    def rests(self) -> bool:
        return bool(self.received) and not self.received[-1].drive.moves

    def publish_state(self, **changes: Any) -> None:
        """The emergency stop's state of the motor owner."""
        raw = codec.encode(ESTOP_STATE, estop_state(**changes))
        self.transport.publish(ESTOP_STATE.topic(self.config.base, owner="serial"), raw, qos=QoS.DELIVERED, retain=True)

    def publish_drive(self, drive: Drive) -> None:
        """A person's command."""
        self.transport.publish(DRIVE.topic(self.config.base), codec.encode(DRIVE, drive), qos=QoS.DELIVERED)

    def close(self) -> None:
        for script in self._scripts:
            if script.poll() is None:
                script.send_signal(signal.SIGKILL)
            script.communicate(timeout=WAIT_S)
        self.transport.close()
        if self.broker is not None:
            self.broker.stop()
        if self.hub is not None and self.hub.running:
            self.hub.end()
        self._folder.cleanup()

    def _receive(self, message: Message) -> None:
        drive = codec.decode(DRIVE, message.payload)
        if drive.signed:
            self.received.append(Received(time.monotonic(), drive))
