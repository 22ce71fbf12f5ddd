"""A whole robot with a list of brokers, an operator who hears all, and what went wrong while brokers failed."""

from __future__ import annotations

import itertools
import json
import random
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pebble.runtime.every_host import EveryHost
from pebble.transports import Message, MqttSettings, QoS, State, TlsSettings, Transport
from tests.robot.operator import Driver, Operator, ReceivedMessage, number_of
from tests.robot.rig import BASE, STOP, Rig
from tests.support import ROOT, Broker, until
from tests.tcp_proxy import TcpProxy

_numbers = itertools.count(1, 5000)
CERTS = ROOT / "tests" / "data" / "tls"


class TransportOperator(Operator):
    """The operator of the rig by a transport of Pebble's, which is not open yet."""

    def __init__(self, transport: Transport) -> None:
        self.base, self.seen, self.transport = BASE, [], transport
        self.transport.open(5.0)
        assert until(lambda: self.transport.state is State.CONNECTED)
        self.transport.subscribe(f"{BASE}/outgoing/#", self._note)

    def close(self) -> None:
        self.transport.close()

    def send(self, suffix: str, body: Any, *, qos: int = 1, retain: bool = False) -> None:
        raw = body if isinstance(body, bytes) else json.dumps(body).encode()
        self.transport.publish(f"{BASE}/{suffix}", raw, qos=QoS(qos), retain=retain, urgent=True)

    def _note(self, message: Message) -> None:
        self.seen.append(ReceivedMessage(time.monotonic(), message.topic, message.payload, message.retain))


class HostsOperator(TransportOperator):
    """At all brokers at once, by the transport of page and tools."""

    def __init__(self, settings: MqttSettings) -> None:
        self.hosts = EveryHost("operator", settings)
        self.moves: list[tuple[float, str]] = []
        self.hosts.moved = lambda base: self.moves.append((time.monotonic(), self.hosts.host_of(base)))
        super().__init__(self.hosts)


@dataclass
class Counts:
    """What must not happen, over all faults; and how long what may took, in seconds."""

    wrong: dict[str, int] = field(default_factory=dict)
    took: dict[str, list[float]] = field(default_factory=dict)

    def add(self, what: str, number: int) -> None:
        self.wrong[what] = self.wrong.get(what, 0) + number

    def note(self, what: str, seconds: float) -> None:
        self.took.setdefault(what, []).append(seconds)

    def __str__(self) -> str:
        times = {what: f"max {max(each):.2f} s of {len(each)}" for what, each in self.took.items()}
        return json.dumps({**self.wrong, **times})


class Hosts:
    """Brokers behind a proxy each, through which the robot reaches them; the operator does so without."""

    def __init__(self, folder: Path, stack: ExitStack, count: int = 2, *, tls: bool = False) -> None:
        self.brokers, self.proxies = [], []
        own = (f"certfile {CERTS}/server.crt", f"keyfile {CERTS}/server.key") if tls else ()
        for _ in range(count):
            broker = Broker(folder, *own)
            stack.callback(broker.kill)
            self.brokers.append(broker)
            proxy = TcpProxy(broker.port)
            stack.callback(proxy.stop)
            self.proxies.append(proxy)
        name = "localhost" if tls else "127.0.0.1"  # as the certificate has it
        places = tuple((name, one.port) for one in self.brokers)
        authority = TlsSettings(ca_cert=CERTS / "ca.crt") if tls else None
        self.operator = HostsOperator(MqttSettings(host=name, port=places[0][1], hosts=places, tls=authority))
        self.rig = stack.enter_context(
            Rig(
                "mqtt",
                remote=self.brokers[0],
                operator=self.operator,
                mqtt_bridge={
                    "enabled": True,
                    "remote_mqtt": {
                        "hosts": [f"{name}:{one.port}" for one in self.proxies],
                        "tls": {"enabled": tls} | ({"ca_cert": str(CERTS / "ca.crt")} if tls else {}),
                    },
                },
            )
        )
        assert self.rig.local is not None
        self.inside = Operator(self.rig.local.port, BASE, "incoming/#")
        stack.callback(self.inside.close)

    @property
    def at(self) -> int:
        """At which host the robot is, as the operator hears it."""
        place = self.operator.hosts.host_of(BASE)
        return next((n for n, one in enumerate(self.brokers) if place.endswith(f":{one.port}")), -1)

    def reset(self) -> None:
        """End the emergency stop."""
        operator = self.operator

        def ended() -> bool:
            states = [
                one.json for one in operator.seen if one.topic.startswith(f"{BASE}/outgoing/estop/") and one.payload
            ]
            if states and states[-1]["latched"]:
                body = {"boot": states[-1]["boot"], "count": states[-1]["count"], "by": "ann"}
                operator.send("incoming/estop-reset", body)
            return bool(states) and not states[-1]["latched"]

        assert until(ended, 10, step=0.2)
        time.sleep(0.7)  # what was on its way is not driven


def _kill(hosts: Hosts, one: int) -> Callable[[], None]:
    hosts.brokers[one].kill()
    return hosts.brokers[one].start


def _freeze(hosts: Hosts, one: int) -> Callable[[], None]:
    hosts.brokers[one].freeze()
    return hosts.brokers[one].thaw


def _part(hosts: Hosts, one: int) -> Callable[[], None]:
    """The robot does not reach it any more, the operator does."""
    hosts.proxies[one].blackhole()
    return hosts.proxies[one].resume


def _cut(hosts: Hosts, one: int) -> Callable[[], None]:
    hosts.proxies[one].cut()
    return hosts.proxies[one].mend


def _freeze_two(hosts: Hosts, one: int) -> Callable[[], None]:
    """The next one, too."""
    heal = [_freeze(hosts, number % len(hosts.brokers)) for number in (one, one + 1)]
    return lambda: [each() for each in heal] and None


FAULTS: dict[str, Callable[[Hosts, int], Callable[[], None]]] = {
    "kill": _kill,
    "freeze": _freeze,
    "part": _part,
    "cut": _cut,
    "freeze two": _freeze_two,
}


@contextmanager
def hosts(folder: Path, count: int = 2, *, tls: bool = False) -> Iterator[Hosts]:
    with ExitStack() as stack:
        yield Hosts(folder, stack, count, tls=tls)


def fail_while_driving(world: Hosts, fault: str, counts: Counts, *, stops: bool = False, held_s: float = 3.0) -> None:
    """Fail the host in use while an operator drives, and count what went wrong until the wheels turn again.

    ``stops``: a stop is pressed at once, and repeated until the robot shows it, as every client of ours does.
    """
    operator, mcu = world.operator, world.rig.mcu
    began = time.monotonic()
    driver = Driver(operator, first=next(_numbers))
    assert until(lambda: mcu.moving(began), 10), world.rig.log.read_text()[-3000:]
    time.sleep(random.uniform(0.1, 0.4))
    before = world.at
    last = operator.on("outgoing/online")[-1].at
    failed_at = time.monotonic()
    heal = FAULTS[fault](world, before)
    if stops:
        _stop(world, failed_at, counts)
        driver.stop()
    assert until(lambda: world.at not in (before, -1), 15), f"at no other host: {world.rig.log.read_text()[-3000:]}"
    moved_at = operator.moves[-1][0]
    counts.note(f"{fault}: heartbeat elsewhere after", moved_at - failed_at)
    counts.note(f"{fault}: gap of heartbeats", moved_at - last)
    if not stops:
        assert until(lambda: any(at > moved_at for at, _ in _commands(world, began)), 5), "no driving at the new host"
        counts.note(f"{fault}: driven again after the heartbeat", _first(world, moved_at) - moved_at)
    time.sleep(max(0.0, held_s - (time.monotonic() - failed_at)))
    heal()
    time.sleep(1.5)  # what was held comes now
    driver.stop()
    assert until(lambda: not mcu.moving(began), 3)
    _count(world, driver, began, failed_at, moved_at, counts, fault)


def _stop(world: Hosts, failed_at: float, counts: Counts) -> None:
    """A stop takes effect within a second after some host is heard again."""
    operator = world.operator
    body = {"stop": f"{random.getrandbits(64):016x}", "by": "ann", "why": "test"}
    end = time.monotonic() + 15
    latched: list[float] = []
    while not latched and time.monotonic() < end:
        operator.send("incoming/estop", body)
        time.sleep(0.1)
        latched = [
            one.at
            for one in list(operator.seen)
            if one.at > failed_at and one.topic.startswith(f"{BASE}/outgoing/estop/") and one.json["latched"]
        ]
    assert latched, "the stop was not confirmed"
    there = next((one.at for one in operator.on("outgoing/online", failed_at + 0.3)), latched[0])
    counts.note("stop confirmed after a host is heard", max(0.0, latched[0] - there))


def _commands(world: Hosts, since: float) -> list[tuple[float, int]]:
    return [(at, number_of(*wheels)) for at, wheels in world.rig.mcu.drives(since) if wheels != STOP]


def _first(world: Hosts, since: float) -> float:
    return min(at for at, _ in _commands(world, since))


def _count(
    world: Hosts, driver: Driver, began: float, failed_at: float, moved_at: float, counts: Counts, fault: str
) -> None:
    inside = [one for one in world.inside.on("incoming/drive-values", began) if one.json.get("x") or one.json.get("z")]
    numbers = [number_of(one.json["z"] + one.json["x"], one.json["z"] - one.json["x"]) for one in inside]
    counts.add("commands", len(numbers))
    counts.add("twice", len(numbers) - len(set(numbers)))
    counts.add("out of order", sum(later < earlier for earlier, later in itertools.pairwise(numbers)))
    ages = [one.at - driver.sent_at[number] for one, number in zip(inside, numbers, strict=True)]
    counts.note("age of a command", max(ages, default=0.0))
    counts.add("older than 1 s", sum(age > 1.0 for age in ages))
    drives = world.rig.mcu.drives(began)
    rests = [then - at for (at, wheels), (then, _) in itertools.pairwise(drives) if wheels != STOP]
    counts.note("wheels left turning", max(rests, default=0.0))
    heartbeats = [one for one in world.operator.on("outgoing/online", began) if not one.retain]
    counts.add(
        "false wills after the robot was heard elsewhere",
        sum(not _alive(one) and one.at > moved_at for one in heartbeats),
    )
    counts.add("wills while it changed", sum(not _alive(one) and failed_at < one.at <= moved_at for one in heartbeats))
    stamps = [one.json["t"] for one in heartbeats if _alive(one)]
    counts.add("values older than the newest", sum(later < earlier for earlier, later in itertools.pairwise(stamps)))


def _alive(one: ReceivedMessage) -> bool:
    return one.json.get("online") is not False
