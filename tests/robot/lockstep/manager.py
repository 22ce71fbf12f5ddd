"""The manager of scripts: the real service, with simulated processes instead of real ones, and the gate's pure part."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import msgspec

from pebble.config import Config
from pebble.contract import DRIVE
from pebble.runtime.runs import CONFIG, RUN
from pebble.services.autonomy_manager.child import Launch
from pebble.services.autonomy_manager.gate import gate as gate_module
from pebble.services.autonomy_manager.gate.client_filter import ClientFilter, Login
from pebble.services.autonomy_manager.gate.gate import Gate
from pebble.services.autonomy_manager.gate.packets import Connect, write_connect
from pebble.services.autonomy_manager.script import Dependency
from pebble.services.autonomy_manager.script import Script as Described
from pebble.services.autonomy_manager.service import AutonomyManager
from tests.robot.lockstep.commands import Commands
from tests.robot.lockstep.network import Connection, Network
from tests.robot.lockstep.people import BASE
from tests.robot.lockstep.processes import Process, ServiceProcess
from tests.robot.lockstep.scripts import OwnScript, Script

_GUARD_S = 0.4  # after the manager's end, what is left of its scripts is killed
_LOCK_S = 0.02
_LOOPBACK_S = 0.0005


class Manager(ServiceProcess):
    """``before`` and ``after`` are called around each turn, ``spawned`` at each start of a script."""

    def __init__(self, network: Network, config: Config, commands: Commands) -> None:
        super().__init__("manager", network.scheduler, lambda process: self._service(network, config))
        self.scripts: list[Script] = []  # of all its lives
        self.newest: Script | None = None
        self.before: Callable[[], None] = lambda: None
        self.after: Callable[[], None] = lambda: None
        self.spawned: Callable[[Script], None] = lambda script: None
        self._network, self._commands = network, commands
        self._gates: dict[Path, LockstepGate] = {}

    @property
    def alive_scripts(self) -> list[Script]:
        return [script for script in self.scripts if script.alive]

    def start(self) -> None:
        """It begins once its predecessor's guard has ended, that is, once the scripts have."""
        if self.alive_scripts and not self.alive:
            self.scheduler.after(_LOCK_S, self.start)
        else:
            super().start()

    def turn(self) -> None:
        self.before()
        with patch.object(gate_module, "Gate", self._gate):
            super().turn()
        self.after()

    def kill(self, restart_s: float | None) -> None:
        """The kernel and the manager's guard end its scripts."""
        if self.alive:
            for script in self.alive_scripts:
                script.signal(signal.SIGTERM if isinstance(script, OwnScript) else signal.SIGKILL)
                self.scheduler.after(_GUARD_S, lambda script=script: script.signal(signal.SIGKILL))  # type: ignore[misc]
        super().kill(restart_s)

    def _service(self, network: Network, config: Config) -> AutonomyManager:
        return AutonomyManager(
            config,
            Connection(self, network),
            clock=self.scheduler.clock,
            spawn=self._spawn,
            scripts={name: _described(name) for name in NAMES},
        )

    def _spawn(self, launch: Launch, ended: Callable[[int], None]) -> Script:
        life = self.lives

        def on_end(code: int) -> None:
            """The watching thread; it ends with the manager, and does not run while that is frozen."""
            self.do(lambda: notify(code))

        def notify(code: int) -> None:
            if self.alive and self.lives == life:
                ended(code)
                self.wake()

        gate = self._gates.get(Path(launch.environment[CONFIG]))
        if gate is None:
            run = int(launch.environment[RUN])
            script: Script = OwnScript(launch.file, run, self._network, self._commands, on_end)
        else:
            script = MqttScript(launch.file, gate.run, self._network, self._commands, on_end, gate)
        self.scripts.append(script)
        self.newest = script
        self.spawned(script)
        return script

    def _gate(self, config: Config, publish: Callable[[str, bytes], object], run: int) -> LockstepGate:
        gate = LockstepGate(self, config, publish, run)
        self._gates[gate.config_path] = gate
        return gate


class LockstepGate(Gate):
    """The gate without sockets. It works on a thread of the manager's process."""

    def __init__(self, manager: Process, config: Config, publish: Callable[[str, bytes], object], run: int) -> None:
        super().__init__(config, publish, run)
        self.run = run
        self._manager = manager
        self._server = self  # type: ignore[assignment]  # only post() of it is used
        self._clients: dict[object, ClientFilter] = {}
        self._closed = False

    @property
    def config_path(self) -> Path:
        return Path(f"/gate/{self.run}.json")

    def open(self) -> None:
        """Nothing listens."""

    def close(self) -> None:
        self._closed = True

    def post(self, job: Callable[[], None]) -> None:
        """Run ``job`` on the gate's thread, which ends with the manager's process and with the gate."""
        life = self._manager.connection

        def work() -> None:
            if not self._closed and self._manager.connection is life:
                job()

        self._manager.scheduler.after(_LOOPBACK_S, lambda: self._manager.do(work))

    # -- what the server does

    def feed(self, client: object, packets: bytes) -> None:
        """Bytes of a client's socket."""
        self.post(lambda: self._feed(client, packets))

    def ended(self, client: object) -> None:
        """The client's socket is closed."""
        self.post(lambda: self._outlet.ended(client, self._manager.scheduler.now))

    def _feed(self, client: object, packets: bytes) -> None:
        if client not in self._clients:
            own = Login(b"script", b"secret")
            self._clients[client] = ClientFilter(self._rules, own, Login())
            self._clients[client].feed(write_connect(Connect(2, b"\0\x3c", b"script", None, *own)))
        for command in self._clients[client].feed(packets).drive:
            self._outlet.receive(command, client, self._manager.scheduler.now)
        self._publish_later()

    def _publish_later(self) -> None:
        due = self._outlet.due
        if due is not None:
            self._manager.scheduler.at(due - _LOOPBACK_S, lambda: self.post(self._publish_due))

    def _publish_due(self) -> None:
        self._outlet.publish_due(self._manager.scheduler.now)
        self._publish_later()


class MqttScript(Script):
    """A script written for MQTT: it signs nothing, and ends as its name says: obeys, ignores or slow."""

    def __init__(self, *arguments: Any) -> None:
        *others, gate = arguments
        super().__init__(*others)
        self._gate = gate
        self._manners = self.file.rpartition("-")[2]
        self._sent = 0

    def _drive(self, now: float) -> None:
        x, z = self._new_command(now)
        self._sent += 1
        axes = {"x": x, "z": z}
        forms: tuple[Any, ...] = (
            axes,
            {"value": axes},
            {**axes, "source": "autonomy", "run": 1 << 25},
            {"value": {**axes, "source": "page"}, "x": 0},
        )
        self._send(forms[self._sent % len(forms)])

    def _zero(self, now: float) -> None:
        self._send({"x": 0, "z": 0, "source": "page"})

    def _close(self, now: float) -> None:
        self._zero(now)

    def _end_on_signal(self, number: signal.Signals) -> None:
        if self._manners == "obeys":
            self._zero(self.scheduler.now)
            self.exit(0)
        elif self._manners == "slow":
            self.scheduler.after(0.8, lambda: self.do(lambda: self.exit(1)))

    def exit(self, code: int) -> None:
        if self.alive:
            self._gate.ended(self)
        super().exit(code)

    def _send(self, body: Any) -> None:
        self._gate.feed(self, publish_packet(DRIVE.topic(BASE), msgspec.json.encode(body)))


def publish_packet(topic: str, payload: bytes) -> bytes:
    """An MQTT PUBLISH of QoS 0 that asks to be retained, as many scripts do."""
    body = len(topic).to_bytes(2, "big") + topic.encode() + payload
    size = len(body)
    length = bytes((size,)) if size < 128 else bytes((size & 127 | 128, size >> 7))
    return b"\x31" + length + body


NAMES = (
    *("steady", "pulse", "flood", "late", "finish", "fail", "crash", "busy", "idle", "steady-needs", "idle-needed"),
    *("steady-mqtt-obeys", "steady-mqtt-ignores", "pulse-mqtt-slow", "crash-mqtt-obeys"),
)


def _described(name: str) -> Described:
    return Described(
        file=name,
        label=name,
        command=(name,),
        folder=Path("/"),
        ours="mqtt" not in name,
        dependencies=(Dependency("idle-needed"),) if name == "steady-needs" else (),
    )
