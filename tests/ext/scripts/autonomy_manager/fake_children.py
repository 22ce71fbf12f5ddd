"""The manager in this process, on the memory transport, with a clock and scripts that only the test moves."""

from __future__ import annotations

import signal
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import replace

from pebble.config import Security
from pebble.contract.payloads import ControlState
from pebble.extensions.operator.client.forms import Setting
from pebble.services.autonomy_manager.child import Launch
from pebble.services.autonomy_manager.script import Dependency, Script
from pebble.services.autonomy_manager.service import AutonomyManager
from pebble.transports import Message, QoS
from tests.ext.operator.client.estop_robot import estop_state
from tests.kit.robot import BASE, Listener, LocalNetwork, Running
from tests.support import Clock, until

MOTORS = {"enabled": True, "serial": {"port": "/dev/null"}}


def script(file: str, *dependencies: Dependency, **more: Any) -> Script:
    speed = Setting(key="speed", type="float", default=0.5, arg="--speed", max=1)
    fields = {"label": file, "settings": (speed,), "ours": True, **more}
    return Script(file=file, command=(file,), folder=Path(), dependencies=dependencies, **fields)


class FakeChild:
    """Runs until the test ends it; remembers its signals."""

    def __init__(self, pid: int, launch: Launch, ended: Callable[[int], None]) -> None:
        self.pid, self.launch, self.running = pid, launch, True
        self.signals: list[signal.Signals] = []
        self._ended = ended

    def signal(self, number: signal.Signals) -> None:
        self.signals.append(number)

    def wait(self, timeout_s: float) -> None:
        """Returns at once: a caller that waits for it gives up."""

    def end(self, code: int) -> None:
        self.running = False
        self._ended(code)


class FakeProcesses:
    """Starts fake children; ``failing`` names scripts that cannot be started."""

    def __init__(self) -> None:
        self.all: list[FakeChild] = []
        self.failing = ""

    def __call__(self, launch: Launch, ended: Callable[[int], None]) -> FakeChild:
        if launch.file == self.failing:
            raise FileNotFoundError(2, "No such file or directory", launch.command[0])
        child = FakeChild(1000 + len(self.all), launch, ended)
        self.all.append(child)
        return child

    @property
    def files(self) -> list[str]:
        """Those alive, in the order of their start."""
        return [child.launch.file for child in self.all if child.running]


class Bench:
    """The service with ``scripts``, and a client that sees and sends what operators and motor owners do.

    Without ``scripts`` it lists those of its folders.
    """

    def __init__(
        self, folder: Path, scripts: Mapping[str, Script] | None, *, named: bool = False, **section: Any
    ) -> None:
        network = LocalNetwork("memory", folder)
        config = network.config(folder, MOTORS, autonomy_manager={"enabled": True, **section})
        if named:
            config = replace(config, security=Security(level="named"))
        self.clock, self.children = Clock(), FakeProcesses()
        self.world = Listener(network.client("world"))
        self.drives: list[dict[str, Any]] = []
        self.world.transport.subscribe(f"{BASE}/incoming/drive-values", self._on_drive, direct=True)
        transport = network.robots_transport(config, "autonomy")
        self.service = AutonomyManager(config, transport, clock=self.clock, spawn=self.children, scripts=scripts)
        self.running = Running(self.service)
        assert until(lambda: self.drives and self.world.newest_raw("autonomy-status"))

    @property
    def status(self) -> dict[str, Any]:
        found: dict[str, Any] = self.world.newest("autonomy-status")
        found.pop("timestamp")
        found.pop("since", None)
        return found

    def becomes(self, **fields: Any) -> bool:
        """Wait until the status has these fields."""
        return until(lambda: fields.items() <= self.status.items())

    def command(self, body: Any, *, retain: bool = False) -> None:
        self.world.command("autonomy-command", body, retain=retain)

    def start(self, file: str, **config: Any) -> FakeChild:
        """Start a script, and wait for its process."""
        before = len(self.children.all)
        self.command({"action": "start", "file": file, "config": config})
        assert until(lambda: file in [child.launch.file for child in self.children.all[before:]]), self.status
        assert self.becomes(running=True, file=file)
        return next(child for child in self.children.all[before:] if child.launch.file == file)

    def stop(self, child: FakeChild) -> None:
        """Command a stop, and wait until a process is asked to end."""
        self.command({"action": "stop"})
        assert until(lambda: child.signals == [signal.SIGTERM])

    def holder(self, by: str) -> None:
        """Publish who has control; empty: it is free."""
        raw = msgspec.json.encode(ControlState(by=by, id="aaaaaaaa", key="0badf00d" if by else ""))
        self.world.transport.publish(f"{BASE}/outgoing/control/serial", raw, qos=QoS.DELIVERED, retain=True)

    def owner(self, **fields: Any) -> None:
        """Publish the state of the motor owner."""
        raw = msgspec.json.encode(estop_state(**fields))
        self.world.transport.publish(f"{BASE}/outgoing/estop/serial", raw, qos=QoS.DELIVERED, retain=True)
        self.quiet()

    def drive(self, **fields: Any) -> None:
        self.world.command("drive-values", fields)

    def advance(self, seconds: float) -> None:
        """Let time pass, and let the service do what is due."""
        self.clock.now += seconds
        self.quiet()

    def quiet(self) -> None:
        """Wait until the service has done what it has received so far."""
        done: list[bool] = []
        self.service.post(lambda: done.append(True))
        assert until(lambda: done)
        self.service.post(lambda: done.append(True))  # after the timers of the first
        assert until(lambda: len(done) == 2)

    def zeros(self, run: int) -> int:
        """How often the manager has stopped the wheels for a run since this began."""
        return self.drives.count({"x": 0.0, "z": 0.0, "y": 0.0, "source": "autonomy", "run": run}) - 1

    def close(self) -> None:
        with suppress(AssertionError):
            self.running.stop()
        self.world.transport.close()

    def _on_drive(self, message: Message) -> None:
        self.drives.append(msgspec.json.decode(message.payload))
