"""The Zenoh fabric of the shared suite: our hub, with a journal, as a process of its own."""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

from pebble.transports import Message, QoS, State, ZenohSettings, create
from tests.support import ROOT, until
from tests.transports.net import Net


class HubProcess:
    """`python -m pebble.transports.zenoh_hub` in `run_dir`; `start` waits until it serves."""

    def __init__(self, run_dir: Path, journal: Path | None = None) -> None:
        self.settings = ZenohSettings(run_dir=run_dir, journal=journal)
        self._process: subprocess.Popen[str] | None = None

    def start(self) -> HubProcess:
        options = [] if self.settings.journal is None else ["--journal", str(self.settings.journal)]
        command = [sys.executable, "-m", "pebble.transports.zenoh_hub", str(self.settings.run_dir), *options]
        self._process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True)
        probe = create("zenoh", "probe", dataclasses.replace(self.settings, client=True)).open(10)
        assert probe.state is State.CONNECTED, probe.problem
        probe.close()
        return self

    def kill(self) -> None:
        self.end(signal.SIGKILL)

    def end(self, number: int = signal.SIGTERM) -> tuple[int, str]:
        """Returns the exit code and what it wrote to stderr."""
        process, self._process = self._process, None
        assert process is not None
        process.send_signal(signal.SIGCONT)
        process.send_signal(number)
        _, said = process.communicate(timeout=10)
        return process.returncode, said

    def signal(self, number: int) -> None:
        os.kill(self.pid, number)

    @property
    def running(self) -> bool:
        return self._process is not None

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def settle(self) -> None:
        """Wait until every message to be kept that living clients have published is in the hub's memory.

        The hub answers a subscriber only then; our own kept copy tells that it has.
        """
        answered: list[Message] = []
        with create("zenoh", "settler", dataclasses.replace(self.settings, client=True)) as client:
            client.publish("settle", b"?", qos=QoS.DELIVERED, retain=True)
            client.subscribe("#", lambda message: answered.append(message))
            assert until(lambda: any(message.topic == "settle" and message.retain for message in answered))
            client.publish("settle", b"", qos=QoS.DELIVERED, retain=True)


class ZenohNet(Net):
    kind = "zenoh"

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._journal = folder / "journal"
        self.hub = HubProcess(folder / "run", self._journal)

    def settings(self, **changes: Any) -> ZenohSettings:
        return dataclasses.replace(self.hub.settings, **changes)

    def start_fabric(self) -> None:
        if not self.hub.running:
            self.hub.start()

    def stop_fabric(self, *, forget: bool = False) -> None:
        if self.hub.running:
            try:
                self.hub.settle()
            finally:
                self.hub.kill()
        if forget:
            self._journal.unlink()

    def heal(self) -> None:
        if self.hub.running:
            self.thaw_fabric()
        else:
            self.start_fabric()

    def freeze_fabric(self) -> None:
        self.hub.signal(signal.SIGSTOP)

    def thaw_fabric(self) -> None:
        self.hub.signal(signal.SIGCONT)
