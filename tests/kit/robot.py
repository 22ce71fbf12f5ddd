"""A robot for tests of its programs: its local transport, a client of it, and programs as processes."""

from __future__ import annotations

import json
import os
import runpy
import shutil
import signal
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec

from pebble.config import Config, load, parse
from pebble.contract import Channel
from pebble.errors import PebbleError
from pebble.extension import part
from pebble.runtime import process
from pebble.runtime import service as service_module
from pebble.runtime.connections import local_transport
from pebble.service import Service
from pebble.transports import Message, MqttSettings, QoS, State, Transport, ZenohSettings, create
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.support import WAIT_S, Broker, until
from tests.transports.forked import Forked
from tests.transports.zenoh_net import HubProcess

ROBOT = "rover"
BASE = f"pebble/robots/{ROBOT}"  # of a rig with a network of its own; of others: rig.base
SILENCE_S = 5.0  # a machine that does too much at once is not a broker that stopped answering


class Listener:
    """A client that subscribes to all outgoing topics of the robot, and can send commands."""

    def __init__(self, transport: Transport, base: str = BASE) -> None:
        self.received: list[Message] = []
        self.at: list[float] = []
        self.base = base
        self.transport = transport.open(WAIT_S)
        assert transport.state is State.CONNECTED, transport.problem
        transport.subscribe(f"{base}/outgoing/#", self._receive, direct=True)

    def _receive(self, message: Message) -> None:
        self.at.append(time.monotonic())
        self.received.append(message)

    def on(self, metric: str) -> list[Message]:
        return [message for message in list(self.received) if message.topic == f"{self.base}/outgoing/{metric}"]

    def payloads(self, metric: str) -> list[Any]:
        return [msgspec.json.decode(message.payload) for message in self.on(metric) if message.payload]

    def newest(self, metric: str) -> Any:
        """Return the newest value on a topic; an empty dict if there is none, or it was cleared."""
        return next((msgspec.json.decode(raw) for raw in self.newest_raw(metric)), {})

    def became(self, metric: str, timeout: float = WAIT_S, **fields: Any) -> bool:
        """Wait until the newest message on a topic has these fields; return whether it has."""
        return until(lambda: fields.items() <= self.newest(metric).items(), timeout)

    def described(self, uid: str | bytes) -> None:
        """Wait for this MCU's manifest."""
        assert until(lambda: self.newest_raw(f"mcu/{uid!s}/describe")), uid

    def got(self, metric: str) -> bool:
        """Wait for a payload on this topic; return whether it has come."""
        return until(lambda: self.payloads(metric))

    def cleared(self, *metrics: str) -> bool:
        """Wait until the newest message on each topic is empty. Also True if there was none: wait for a value first."""
        return until(lambda: not any(self.newest_raw(metric) for metric in metrics))

    def values(self, metric: str) -> list[Any]:
        """Return the ``value`` of each payload on this topic."""
        return [body["value"] for body in self.payloads(metric)]

    def newest_raw(self, metric: str) -> list[bytes]:
        """Return a list with the payload of the newest message on a topic; an empty list if it was cleared."""
        return [message.payload for message in self.on(metric)[-1:] if message.payload]

    def command(self, metric: str, body: Any, *, retain: bool = False) -> None:
        raw = body if isinstance(body, bytes) else json.dumps(body).encode()
        topic = f"{self.base}/incoming/{metric}"
        sent = until(lambda: self.transport.publish(topic, raw, qos=QoS.DELIVERED, retain=retain))
        assert sent, self.transport.problem


class LocalNetwork:
    """A robot's local transport of one kind: ``memory``, ``mqtt`` (a real mosquitto) or ``zenoh`` (our hub)."""

    def __init__(self, kind: str, folder: Path) -> None:
        self.kind, self._ends = kind, ExitStack()
        self.transport: dict[str, Any] = {}
        self.local_mqtt: dict[str, Any] = {}
        if kind == "memory":
            self._memory = MemoryHub()
        elif kind == "mqtt":
            broker = Broker(folder)
            self._ends.callback(broker.stop)
            self.local_mqtt = {"host": "127.0.0.1", "port": broker.port}
            self._mqtt = MqttSettings(host="127.0.0.1", port=broker.port)
        else:
            self._run_dir = folder / "run"
            hub = HubProcess(self._run_dir).start()
            self._ends.callback(hub.kill)
            self.transport = {"kind": "zenoh", "run_dir": str(self._run_dir)}

    def config(self, folder: Path, serial: dict[str, Any], *, robot: str = ROBOT, **services: Any) -> Config:
        raw = {
            "robot": {"id": robot},
            "transport": {"kind": "mqtt", **self.transport, "state_dir": str(folder / "state")},
            "local_mqtt": self.local_mqtt,
            "services": {"serial_mcu_bridge": serial, **services},
        }
        return parse(raw, folder=folder, env={})

    def robots_transport(self, config: Config, name: str) -> Transport:
        """Return the transport that the robot's process ``name`` would use."""
        if self.kind == "memory":
            return MemoryTransport(name, self._memory)
        return local_transport(config, name)

    def client(self, name: str) -> Transport:
        if self.kind == "memory":
            return MemoryTransport(name, self._memory)
        if self.kind == "mqtt":
            return create("mqtt", name, self._mqtt)
        return create("zenoh", name, ZenohSettings(run_dir=self._run_dir, client=True))

    def close(self) -> None:
        self._ends.close()


class Running:
    """A service that runs on a thread, as it does in its process; ``error`` is the exception that ended it."""

    def __init__(self, service: Service) -> None:
        self.service = service
        self.error: PebbleError | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self.service.run()
        except PebbleError as error:
            self.error = error

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

    def stop(self) -> None:
        self.service.quit()
        self._thread.join(WAIT_S)
        assert not self._thread.is_alive(), "the service does not end"


def main(module: str, arguments: tuple[str, ...], environment: dict[str, str]) -> None:
    """Become ``python -m module``, or a service, in a process that has imported most of what it needs."""
    os.environ.clear()
    os.environ.update(environment)
    sys.argv = [module, *arguments]
    if ":" in module:
        sys.exit(process.run(part(module)))
    runpy.run_module(module, run_name="__main__", alter_sys=True)


class Program(Forked):
    """A module, or the service ``module:Class``, with these arguments and this process's environment.

    It is ended with what made it.
    """

    def __init__(self, module: str, *arguments: str) -> None:
        super().__init__("tests.kit.robot", module, arguments, dict(os.environ))

    def send_signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def end(self, number: int = signal.SIGTERM) -> int | None:
        """Send a signal; return the exit code."""
        if self.poll() is None:
            self.send_signal(number)
        code = self.wait(10)
        assert self.poll() is not None, "the program does not end"
        return code


class ProgramRobot:
    """A robot whose programs are processes, with a client on its local transport (``world``).

    A robot on MQTT uses the broker at ``port``; a robot on Zenoh has a hub of its own. Its id is the name of its
    folder, unless ``robot`` names it, because a broker retains what others have published.
    """

    def __init__(
        self, kind: str, port: int, services: dict[str, Any], *, robot: str = "", folder: Path | None = None
    ) -> None:
        self._ends = ExitStack()
        if folder is None:
            folder = Path(tempfile.mkdtemp(prefix="pbl")).resolve()  # short: it holds unix sockets
            self._ends.callback(shutil.rmtree, folder, ignore_errors=True)
        self.folder, self.path = folder, folder / "robot.json"
        (folder / "run").mkdir(mode=0o700)
        self.raw: dict[str, Any] = {
            "robot": {"id": robot or folder.name},
            "transport": {"kind": kind, "run_dir": str(folder / "run"), "state_dir": str(folder / "state")},
            "local_mqtt": {"host": "127.0.0.1", "port": port, "silence_seconds": SILENCE_S},
            "services": services,
        }
        self.config = self.write()
        if kind == "zenoh":
            self._ends.callback(HubProcess(self.config.run_dir()).start().kill)
        self.world = Listener(local_transport(self.config, "world"), self.config.base)
        self._ends.callback(self.world.transport.close)

    def write(self) -> Config:
        """Write ``raw`` as the config file, and return the config."""
        self.path.write_text(json.dumps(self.raw))
        return load(self.path)

    def run(self, module: str, *arguments: str) -> Program:
        """Start a program with the config; it ends with the robot."""
        program = Program(module, str(self.path), *arguments)
        self._ends.callback(program.end)
        return program

    def close(self) -> None:
        self._ends.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()


def handled(service: type[Service]) -> list[Channel]:
    """Return the channels that a service subscribes to, in order."""
    return [getattr(service, name).channel for name in service_module._marked(service, "channel")]
