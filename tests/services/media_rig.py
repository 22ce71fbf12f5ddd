"""One media program as a process of its own, with the robot's local transport and a broker for operators."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec

from pebble.config import Config, load
from pebble.contract.payloads import MediaReport
from pebble.runtime.connections import hub_settings, local_transport
from pebble.transports import Message, MqttSettings, QoS, State, Transport, create
from tests.support import ROOT, Child, until

BASE = "pebble/robots/rover"
_SILENCE_S = 5.0  # a machine that does too much at once is not a broker that stopped answering


class MediaProgram:
    """``python -m pebble.services.<name>`` of a robot with ``kind`` inside, and what it reports there.

    ``section`` of services.mqtt_bridge.media holds the ``options``; operators' requests come on ``request``.
    """

    def __init__(
        self, name: str, section: str, request: str, kind: str, local_port: int, remote_port: int, **options: Any
    ) -> None:
        self.name, self._request, self._kind = name, f"{BASE}/incoming/{request}", kind
        self._ends = ExitStack()
        self.folder = Path(tempfile.mkdtemp(prefix="pbl"))  # short: it holds unix sockets
        self._ends.callback(shutil.rmtree, self.folder, ignore_errors=True)
        self.config = self._write_config(local_port, remote_port, {section: options})
        self.reports: list[MediaReport] = []
        self.process: subprocess.Popen[bytes]

    def __enter__(self) -> Self:
        if self._kind == "zenoh":
            self._start("pebble.runtime.hub", msgspec.json.encode(hub_settings(self.config), enc_hook=str).decode())
        self.local = local_transport(self.config, "somebody").open(10)
        self._ends.callback(self.local.close)
        assert self.local.state is State.CONNECTED, self.local.problem
        self.local.subscribe(f"{BASE}/outgoing/media-report/{self.name}", self._note)
        self.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._ends.close()

    def start(self) -> None:
        self.process = self._start(f"pebble.services.{self.name}", str(self.config.path))

    @property
    def run_dir(self) -> Path:
        return self.config.run_dir()

    def ask(self, **request: Any) -> None:
        """What the bridge passes on from operators."""
        body = json.dumps({"enabled": True, **request}).encode()
        assert until(lambda: self.local.publish(self._request, body, qos=QoS.DELIVERED)), self.local.problem

    @property
    def newest(self) -> MediaReport:
        """The last report; before the first one, one that says nothing."""
        return self.reports[-1] if self.reports else MediaReport(running=False)

    def reported(self, timeout: float = 15.0, **expected: Any) -> bool:
        """Until the newest report says so."""
        return until(lambda: all(getattr(self.newest, name) == value for name, value in expected.items()), timeout)

    def _note(self, message: Message) -> None:
        self.reports.append(msgspec.json.decode(message.payload, type=MediaReport))

    def _start(self, module: str, argument: str) -> subprocess.Popen[bytes]:
        process = Child([sys.executable, "-m", module, argument], cwd=ROOT)
        self._ends.callback(process.wait, 10)
        self._ends.callback(process.terminate)
        return process

    def _write_config(self, local_port: int, remote_port: int, media: dict[str, Any]) -> Config:
        run_dir = self.folder / "run"
        run_dir.mkdir(mode=0o700)
        raw = {
            "robot": {"id": "rover"},
            "transport": {"kind": self._kind, "run_dir": str(run_dir)},
            "local_mqtt": _broker(local_port),
            "services": {"mqtt_bridge": {"enabled": True, "remote_mqtt": _broker(remote_port), "media": media}},
        }
        path = self.folder / "robot.json"
        path.write_text(json.dumps(raw))
        return load(path)


def _broker(port: int) -> dict[str, Any]:
    return {"host": "127.0.0.1", "port": port, "silence_seconds": _SILENCE_S}


def client(name: str, port: int) -> Transport:
    transport = create("mqtt", name, MqttSettings(host="127.0.0.1", port=port, silence_s=_SILENCE_S)).open(10)
    assert transport.state is State.CONNECTED, transport.problem
    return transport
