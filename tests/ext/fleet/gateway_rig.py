"""A hub, a broker and a gateway between them as processes; robots that count numbered commands, and an operator."""

from __future__ import annotations

import itertools
import json
import os
import signal
import statistics
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

import msgspec

from pebble.contract import CHANNELS, DRIVE, ESTOP, MQTT_VIDEO, ONLINE, Kind
from pebble.transports import Message, MqttSettings, QoS, State, Transport, ZenohSettings, create
from tests.support import Broker, free_port, until
from tests.tcp_proxy import TcpProxy
from tests.transports.forked import Forked

COMMANDS_HZ, HEARTBEAT_EACH, EVENT_EACH = 40, 10, 4  # of the commands each tenth comes with a heartbeat
NEVER = ("commands twice", "commands out of order", "commands older than 1 s", "events twice", "events out of order")
_STATES = [one for one in CHANNELS if one.kind is Kind.STATE and not one.is_pattern]  # a robot retains that many
_EVENT = "outgoing/counted"  # the contract does not know it: an event


class Arrival(NamedTuple):
    number: int
    at: float


class Robot:
    """A robot as the hub sees it: what its bridge publishes there, and what it takes."""

    def __init__(self, name: str, client: Transport) -> None:
        self.base, self.client = f"pebble/robots/{name}", client
        self.commands: list[Arrival] = []
        self.stops: dict[str, float] = {}
        self.flags: list[bytes] = []
        self.events = itertools.count(1)
        for state in _STATES:
            client.publish(state.topic(self.base), b"{}", qos=QoS.DELIVERED, retain=True)
        client.subscribe(DRIVE.topic(self.base), self._on_drive, direct=True)
        client.subscribe(ESTOP.topic(self.base), self._on_stop, direct=True)
        client.subscribe(MQTT_VIDEO.topic(self.base), lambda message: self.flags.append(message.payload), direct=True)

    def publish_heartbeat(self) -> None:
        heartbeat = json.dumps({"t": int(time.time() * 1000)}).encode()
        self.client.publish(ONLINE.topic(self.base), heartbeat, qos=QoS.DELIVERED, retain=True)

    def publish_event(self) -> None:
        self.client.publish(f"{self.base}/{_EVENT}", str(next(self.events)).encode(), qos=QoS.DELIVERED)

    def _on_drive(self, message: Message) -> None:
        if message.payload.strip():  # else a probe for cycles
            self.commands.append(Arrival(json.loads(message.payload)["n"], time.monotonic()))

    def _on_stop(self, message: Message) -> None:
        self.stops.setdefault(json.loads(message.payload)["stop"], time.monotonic())


class Process:
    """`pebble fleet gateway FILE`, through a proxy on each side, unless it is not ``proxied``."""

    def __init__(self, folder: Path, name: str, hub: int, broker: int, *, proxied: bool) -> None:
        self.name = name
        self.hub, self.broker = TcpProxy(hub), TcpProxy(broker)
        ports = (self.hub.port, self.broker.port) if proxied else (hub, broker)
        self._file = folder / f"{name}.json"
        settings = {
            "id": name,
            "hub": {"connect": [f"tcp/127.0.0.1:{ports[0]}"]},
            "mqtt": {"host": "127.0.0.1", "port": ports[1]},
        }
        self._file.write_text(json.dumps(settings))
        self._process: Forked | None = None
        self.start()

    def start(self) -> None:
        self._process = Forked("tests.ext.fleet.gateway_process", str(self._file))

    @property
    def printed(self) -> str:
        return "" if self._process is None else self._process.printed

    def ends(self, within_s: float) -> int | None:
        """Wait until it has ended; returns its exit status."""
        assert self._process is not None
        return self._process.wait(within_s)

    def signal(self, number: int) -> None:
        assert self._process is not None
        os.kill(self._process.pid, number)

    def kill(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait(10)

    def close(self) -> None:
        self.kill()
        self.hub.stop()
        self.broker.stop()


class World:
    """One client stands for all robots where there are ``many``, and each is driven once a second."""

    def __init__(self, folder: Path, stack: ExitStack, robots: int, *, proxied: bool, many: bool = False) -> None:
        self._folder, self._stack, self._proxied = folder, stack, proxied
        self._hz, self._heartbeat_each = (1, 1) if many else (COMMANDS_HZ, HEARTBEAT_EACH)
        self.broker = Broker(folder, "max_queued_messages 20000")
        stack.callback(self.broker.kill)
        self.hub_port = free_port()
        settings = ZenohSettings(run_dir=folder / "hub", listen=(f"tcp/127.0.0.1:{self.hub_port}",))
        hub = Forked("pebble.runtime.hub", [msgspec.json.encode(settings, enc_hook=str).decode()])
        stack.callback(hub.kill)
        shared = self._client("robots", stack) if many else None
        self.robots = [Robot(f"r{n}", shared or self._client(f"r{n}", stack)) for n in range(robots)]
        self.operator = create("mqtt", "operator", MqttSettings(host="127.0.0.1", port=self.broker.port)).open(10)
        stack.callback(self.operator.close)
        self.events: defaultdict[str, list[Arrival]] = defaultdict(list)
        self.retained: dict[str, bytes] = {}
        self.sent: dict[int, float] = {}
        self._numbers, self._stops, self._ending = itertools.count(1), itertools.count(1), threading.Event()
        self.operator.subscribe("pebble/robots/+/outgoing/#", self._note, direct=True)
        self.direct: list[Arrival] = []  # the first robot's commands, as a robot at the broker receives them
        beside = create("mqtt", "beside", MqttSettings(host="127.0.0.1", port=self.broker.port)).open(10)
        stack.callback(beside.close)
        beside.subscribe(DRIVE.topic(self.robots[0].base), self._note_direct, direct=True)
        self.gateway = self.process("gate-1")
        thread = threading.Thread(target=self._drive, daemon=True)
        thread.start()
        stack.callback(thread.join)
        stack.callback(self._ending.set)

    def process(self, name: str) -> Process:
        """Start a gateway."""
        process = Process(self._folder, name, self.hub_port, self.broker.port, proxied=self._proxied)
        self._stack.callback(process.close)
        return process

    def _client(self, name: str, stack: ExitStack) -> Transport:
        connect = (f"tcp/127.0.0.1:{self.hub_port}",)
        settings = ZenohSettings(run_dir=self._folder / name, connect=connect, client=True)
        client = create("zenoh", name, settings).open(20)
        stack.callback(client.close)
        assert until(lambda: client.state is State.CONNECTED, 30), client.problem
        return client

    # -- what happens all the time

    def _drive(self) -> None:
        """Send commands, heartbeats and events by one schedule: what is late is late for all."""
        due = time.monotonic()
        for number in self._numbers:
            if self._ending.wait(max(0.0, due - time.monotonic())):
                return
            due += 1 / self._hz
            command = json.dumps({"x": 0.5, "z": 0.0, "n": number}).encode()
            self.sent[number] = time.monotonic()
            for robot in self.robots:
                self.operator.publish(DRIVE.topic(robot.base), command, qos=QoS.DELIVERED)
                if number % self._heartbeat_each == 0:
                    robot.publish_heartbeat()
                if number % EVENT_EACH == 0:
                    robot.publish_event()

    def _note(self, message: Message) -> None:
        _, _, robot, metric = message.topic.split("/", 3)
        if metric == _EVENT:
            self.events[robot].append(Arrival(int(message.payload), time.monotonic()))
        else:
            self.retained[message.topic] = message.payload

    def _note_direct(self, message: Message) -> None:
        self.direct.append(Arrival(json.loads(message.payload)["n"], time.monotonic()))

    # -- what is asked of it

    def p50_ms(self) -> tuple[float, float]:
        """What a command takes to the first robot, and to one at the broker."""
        each = (
            [1000 * (one.at - self.sent[one.number]) for one in seen] for seen in (self.robots[0].commands, self.direct)
        )
        through, direct = (statistics.median(times) for times in each)
        return round(through, 2), round(direct, 2)

    def driven(self, since: float) -> bool:
        """Whether each robot has had a command that was sent after ``since``."""
        return all(one.commands and self.sent[one.commands[-1].number] > since for one in self.robots)

    def wait_until_carried(self) -> None:
        """Wait until every robot is driven without a break: after a start, or a fault."""
        now = time.monotonic()
        assert until(lambda: self.driven(now + 2.5), 60), [len(one.commands) for one in self.robots]

    def of(self, name: str) -> list[Robot]:
        """The robot of this name, or all."""
        return [one for one in self.robots if not name or one.base.endswith(f"/{name}")]

    def stop(self, of: str = "") -> float:
        """Stop a robot, or each, once; seconds until the last one has heard it."""
        name, began, robots = f"s{next(self._stops):015d}", time.monotonic(), self.of(of)
        for robot in robots:
            stop = json.dumps({"stop": name, "by": "ann"}).encode()
            self.operator.publish(ESTOP.topic(robot.base), stop, qos=QoS.DELIVERED, urgent=True)
        assert until(lambda: all(name in one.stops for one in robots), 10), "a stop did not arrive"
        return max(one.stops[name] for one in robots) - began

    def outage_s(self, since: float, of: str = "") -> float:
        """The longest time without a command, of a robot or of any."""
        gaps = (b.at - a.at for one in self.of(of) for a, b in itertools.pairwise(one.commands) if b.at > since)
        return max(gaps)

    def wrong(self) -> dict[str, int]:
        """What must never happen, since the start."""
        counts = dict.fromkeys(NEVER, 0)
        for one in self.robots:
            counts["commands older than 1 s"] += sum(seen.at - self.sent[seen.number] > 1 for seen in one.commands)
        both = ("commands", [one.commands for one in self.robots]), ("events", list(self.events.values()))
        for what, each in both:
            for seen in each:
                numbers = [one.number for one in seen]
                counts[f"{what} twice"] += len(numbers) - len(set(numbers))
                counts[f"{what} out of order"] += sum(b < a for a, b in itertools.pairwise(numbers))
        return counts


def _kill(one: Process) -> Callable[[], None]:
    one.kill()
    return one.start


def _hang(one: Process) -> Callable[[], None]:
    one.signal(signal.SIGSTOP)
    return lambda: one.signal(signal.SIGCONT)


def _part(proxy: str) -> Callable[[Process], Callable[[], None]]:
    def part(one: Process) -> Callable[[], None]:
        getattr(one, proxy).blackhole()
        return getattr(one, proxy).resume  # type: ignore[no-any-return]

    return part


def _cut(proxy: str) -> Callable[[Process], Callable[[], None]]:
    def cut(one: Process) -> Callable[[], None]:
        getattr(one, proxy).cut()
        return getattr(one, proxy).mend  # type: ignore[no-any-return]

    return cut


#: Each does something to a gateway, and returns what ends it.
FAULTS: dict[str, Callable[[Process], Callable[[], None]]] = {
    "kill": _kill,
    "hang": _hang,
    "hub cut": _cut("hub"),
    "broker cut": _cut("broker"),
    "hub silent": _part("hub"),
    "broker silent": _part("broker"),
}


@contextmanager
def world(folder: Path, robots: int = 6, **options: bool) -> Iterator[World]:
    with ExitStack() as stack:
        made = World(folder, stack, robots, **{"proxied": True, **options})
        made.wait_until_carried()
        yield made
