"""A robot's local transport with a stand-in for its motor owner, and scripts as real processes on it."""

from __future__ import annotations

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
from tests.commands.command_line import config_file
from tests.ext.operator.client.estop_robot import estop_state
from tests.kit.robot import LocalNetwork
from tests.support import WAIT_S, Child, until


class Received(NamedTuple):
    at: float  # monotonic
    drive: Drive


class Station:
    """Broker or hub, the robot's config, what its motor owner receives, and the scripts that are running."""

    def __init__(self, kind: str) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="pbl")  # pytest's own may be too long for a socket
        self.folder = Path(self._folder.name)
        (self.folder / "run").mkdir(mode=0o700)
        (self.folder / "run" / LAUNCHER_LOCK).write_text(f"{os.getpid()}\n")
        self._network = LocalNetwork(kind, self.folder)
        transport = {"kind": kind, "run_dir": str(self.folder / "run")}
        self.config_path = config_file(self.folder, local_mqtt=self._network.local_mqtt, transport=transport)
        self.config = load(self.config_path)
        self.received: list[Received] = []
        self._scripts: list[subprocess.Popen[str]] = []
        self.transport = local_transport(self.config, "owner")
        self.transport.open(WAIT_S)
        self.transport.subscribe(DRIVE.topic(self.config.base), self._receive)
        self.publish_state()

    def start(self, body: str, run: int | None = None) -> subprocess.Popen[str]:
        """Start a script whose ``main(robot)`` is these lines; its output is one pipe."""
        path = self.folder / f"script{len(self._scripts)}.py"
        lines = "\n".join(f"    {line}" for line in body.splitlines())
        before, after = "import os, sys, time\nfrom pebble import Robot, run\n\n", "\n\nrun(main)\n"
        path.write_text(f"{before}def main(robot: Robot) -> None:\n{lines}{after}")
        return self.start_file(path, run=run)

    def start_file(self, path: Path, *options: str, run: int | None = None) -> subprocess.Popen[str]:
        """Start this program with the robot's config; ``run`` as the manager gives it."""
        env = os.environ if run is None else {**os.environ, "PEBBLE_RUN": str(run)}
        command = [sys.executable, str(path), "--config", str(self.config_path), *options]
        script = Child(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=env)
        self._scripts.append(script)
        return script

    def driven(self, body: str, run: int | None = None) -> subprocess.Popen[str]:
        """Start it, and wait until it drives."""
        before = len(self.received)
        script = self.start(body, run)
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
        self._network.close()
        self._folder.cleanup()

    def _receive(self, message: Message) -> None:
        drive = codec.decode(DRIVE, message.payload)
        if drive.signed:
            self.received.append(Received(time.monotonic(), drive))
