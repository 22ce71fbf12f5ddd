"""A hub, a broker and a gateway between them as processes; robots that count numbered commands, and an operator."""

from __future__ import annotations

import itertools
import json
import os
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

import msgspec

from pebble.contract import CAPABILITIES, DRIVE, ESTOP, ONLINE
from pebble.transports import Message, MqttSettings, QoS, State, ZenohSettings, create
from tests.support import Broker, free_port, until
from tests.transports.forked import Forked

COMMANDS_HZ, HEARTBEAT_EACH = 40, 10  # of the commands each tenth comes with a heartbeat


class Arrival(NamedTuple):
    number: int
    at: float


class CountingRobot:
    """A robot as the hub sees it: what its bridge publishes there, and what it takes."""

    def __init__(self, name: str, settings: ZenohSettings, stack: ExitStack) -> None:
        self.base, self._client = f"pebble/robots/{name}", create("zenoh", name, settings).open(20)
        stack.callback(self._client.close)
        assert until(lambda: self._client.state is State.CONNECTED, 30), self._client.problem
        self.commands: list[Arrival] = []
        self.stops: dict[str, float] = {}
        self._client.publish(CAPABILITIES.topic(self.base), b"{}", qos=QoS.DELIVERED, retain=True)
        self._client.subscribe(DRIVE.topic(self.base), self._on_drive, direct=True)
        self._client.subscribe(ESTOP.topic(self.base), self._on_stop, direct=True)

    def publish_heartbeat(self) -> None:
        heartbeat = json.dumps({"t": int(time.time() * 1000)}).encode()
        self._client.publish(ONLINE.topic(self.base), heartbeat, qos=QoS.DELIVERED, retain=True)

    def _on_drive(self, message: Message) -> None:
        if message.payload.strip():  # else a probe for cycles
            self.commands.append(Arrival(json.loads(message.payload)["n"], time.monotonic()))

    def _on_stop(self, message: Message) -> None:
        self.stops.setdefault(json.loads(message.payload)["stop"], time.monotonic())


class GatewayProcess:
    """`pebble fleet gateway FILE`."""

    def __init__(self, folder: Path, name: str, hub: int, broker: int) -> None:
        self._file = folder / f"{name}.json"
        sides = {"hub": {"connect": [f"tcp/127.0.0.1:{hub}"]}, "mqtt": {"host": "127.0.0.1", "port": broker}}
        self._file.write_text(json.dumps({"id": name, **sides}))
        self.start()

    def start(self) -> None:
        self._process = Forked("tests.ext.fleet.gateway_process", str(self._file))

    @property
    def printed(self) -> str:
        return self._process.printed

    def ends(self, within_s: float) -> int | None:
        """Wait until it has ended; returns its exit status."""
        return self._process.wait(within_s)

    def signal(self, number: int) -> None:
        os.kill(self._process.pid, number)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait(10)


class Hall:
    """Robots at a hub, which an operator at a broker drives all the time."""

    def __init__(self, folder: Path, stack: ExitStack, robots: int) -> None:
        self._folder, self._stack = folder, stack
        self.broker = Broker(folder, "max_queued_messages 20000")
        stack.callback(self.broker.kill)
        self.hub_port = free_port()
        endpoint = (f"tcp/127.0.0.1:{self.hub_port}",)
        settings = ZenohSettings(run_dir=folder / "hub", listen=endpoint)
        hub = Forked("pebble.runtime.hub", [msgspec.json.encode(settings, enc_hook=str).decode()])
        stack.callback(hub.kill)
        self.robots = [
            CountingRobot(name, ZenohSettings(run_dir=folder / name, connect=endpoint, client=True), stack)
            for name in (f"r{number}" for number in range(robots))
        ]
        self.operator = create("mqtt", "operator", MqttSettings(host="127.0.0.1", port=self.broker.port)).open(10)
        stack.callback(self.operator.close)
        self.sent: dict[int, float] = {}
        self._numbers, self._stops, self._ending = itertools.count(1), itertools.count(1), threading.Event()
        self.gateway = self.process("gate-1")
        thread = threading.Thread(target=self._drive, daemon=True)
        thread.start()
        stack.callback(thread.join)
        stack.callback(self._ending.set)

    def process(self, name: str) -> GatewayProcess:
        """Start a gateway."""
        process = GatewayProcess(self._folder, name, self.hub_port, self.broker.port)
        self._stack.callback(process.kill)
        return process

    def _drive(self) -> None:
        """Send commands and heartbeats by one schedule: what is late is late for all."""
        due = time.monotonic()
        for number in self._numbers:
            if self._ending.wait(max(0.0, due - time.monotonic())):
                return
            due += 1 / COMMANDS_HZ
            command = json.dumps({"x": 0.5, "z": 0.0, "n": number}).encode()
            self.sent[number] = time.monotonic()
            for robot in self.robots:
                self.operator.publish(DRIVE.topic(robot.base), command, qos=QoS.DELIVERED)
                if number % HEARTBEAT_EACH == 0:
                    robot.publish_heartbeat()

    def driven(self, since: float) -> bool:
        """Return True if each robot has had a command that was sent after ``since``."""
        return all(robot.commands and self.sent[robot.commands[-1].number] > since for robot in self.robots)

    def wait_until_carried(self) -> None:
        """Wait until every robot is driven without a break: after a start, or a fault."""
        now = time.monotonic()
        assert until(lambda: self.driven(now + 2.5), 60), [len(robot.commands) for robot in self.robots]

    def stop(self) -> float:
        """Stop each robot once; return the seconds until the last one has heard it."""
        name, began = f"s{next(self._stops):015d}", time.monotonic()
        for robot in self.robots:
            stop = json.dumps({"stop": name, "by": "ann"}).encode()
            self.operator.publish(ESTOP.topic(robot.base), stop, qos=QoS.DELIVERED, urgent=True)
        assert until(lambda: all(name in robot.stops for robot in self.robots), 10), "a stop did not arrive"
        return max(robot.stops[name] for robot in self.robots) - began

    def wrong(self) -> int:
        """Count the commands that came twice, after a newer one, or older than 1 s."""
        late = sum(seen.at - self.sent[seen.number] > 1 for robot in self.robots for seen in robot.commands)
        pairs = (pair for robot in self.robots for pair in itertools.pairwise(robot.commands))
        return late + sum(later.number <= earlier.number for earlier, later in pairs)


@contextmanager
def hall_of(folder: Path, robots: int) -> Iterator[Hall]:
    with ExitStack() as stack:
        hall = Hall(folder, stack, robots)
        hall.wait_until_carried()
        yield hall
