"""Bridge and mirror in virtual time, between networks in memory: nothing runs but by :meth:`World.run`."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import pytest

from pebble.config import Config, parse
from pebble.forwarding.service import ForwardingService
from pebble.forwarding.side import RESTORED_S, Gate
from pebble.services.mqtt_bridge import service as bridge_module
from pebble.services.mqtt_bridge.service import MqttBridge
from pebble.services.mqtt_mirror import service as mirror_module
from pebble.services.mqtt_mirror.service import MqttMirror
from pebble.transports import Answer, Message, Outgoing, clock
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.services.mqtt_bridge.bridge_rig import Client, make_config

SERVICES: dict[str, type[ForwardingService]] = {"bridge": MqttBridge, "mirror": MqttMirror}


class Hub(MemoryHub):
    def now(self) -> None:
        """Messages have not waited: the time of the machine means nothing here."""


class Connection(MemoryTransport):
    """A client without a thread, whose connection can be cut."""

    def __init__(self, name: str, hub: Hub, world: World, *, will: Message | None = None) -> None:
        super().__init__(name, hub, will=will)
        self._away = self._held = False
        self._stopping = True  # until it is opened
        self.way = Outgoing()  # what a service measures of it
        self.reply: Answer | None = Answer(0, 0.0, None)
        self.late_s = 0.0  # so long what arrives has waited at the broker
        self.renewed: list[float] = []  # when the service has asked for another connection
        self._world = world
        world.connections.append(self)

    @property
    def outgoing(self) -> Outgoing:
        return self.way

    @property
    def answer(self) -> Answer | None:
        return self.reply

    def answers(self, seconds: float) -> None:
        """The next question is answered, after so long."""
        self.reply = Answer(1 if self.reply is None else self.reply.number + 1, seconds, None)

    def receive(self, delivery: Any) -> None:
        if self.as_published and delivery.message.retain_requested:
            delivery = replace(delivery, message=msgspec.structs.replace(delivery.message, retain=True))
        if self.late_s:
            since = clock.since_boot() - self.late_s
            delivery = replace(delivery, message=msgspec.structs.replace(delivery.message, waiting_since=since))
        super().receive(delivery)

    def renew_connection(self, why: str) -> None:
        self.renewed.append(self._world.now)
        self._on_hub_stopped()

    def cut(self) -> None:
        self._away = True

    def mend(self) -> None:
        self._away = False

    def hold(self) -> None:
        """What is sent to it waits at the broker."""
        self._held = True

    def let_go(self) -> None:
        self._held = False

    def lose(self) -> None:
        """The broker drops what waits, without a word."""
        self._inbox.clear()

    def refuse(self) -> None:
        """The broker delivers nothing of what it is subscribed to."""
        for subscription in self._subscriptions:
            subscription.refused = True

    def lead_to(self, hub: Hub) -> None:
        """The connection is lost, and the address leads to another broker from now on."""
        self._on_hub_stopped()
        self._hub.leave(self)
        self._hub, self._changed = hub, threading.Condition(hub.lock)
        hub.enter(self)

    def work(self) -> bool:
        """Do one thing, if there is one to do."""
        if self._stopping or not ((self._inbox and not self._held) or self._attached != self._reachable):
            return False
        if self._away and self._attached is not None:
            self._on_hub_stopped()
        else:
            self._work()
        return True

    @property
    def _reachable(self) -> int | None:
        return None if self._away else self._hub.era

    @property
    def _present(self) -> bool:
        return self._attached is not None and self._attached == self._reachable

    def _open(self, timeout: float) -> None:
        self._stopping = False
        self._hub.enter(self)
        while timeout and self.work():
            pass


class Running(NamedTuple):
    """A service and its connections."""

    service: ForwardingService
    here: Connection  # on the robot's side
    uplink: Connection
    stops: Connection | None  # of a bridge that has one for stops alone

    @property
    def gate(self) -> Gate:
        return self.service.forwarder.gate


class World:
    """Two sides with a client on each, and a service between them that can be restarted; others may run beside it."""

    def __init__(self, service: str, monkeypatch: pytest.MonkeyPatch, *, one: bool = False) -> None:
        self.name = service
        self.now = 100.0
        self.connections: list[Connection] = []
        self.local_hub = Hub()
        self.remote_hub = self.local_hub if one else Hub()
        self.as_published = False  # connections of services show retain flags as they were published
        self.saved: dict[Hub, dict[str, Message]] = {}
        self.local = Client(Connection("someone-local", self.local_hub, self))
        self.remote = Client(Connection("operator", self.remote_hub, self))
        self.running: list[Running] = []
        for module, name in ((bridge_module, "remote_transport"), (mirror_module, "mirror_transport")):
            monkeypatch.setattr(module, name, self._uplink)
        monkeypatch.setattr(bridge_module, "stops_transport", self._stops)

    @property
    def service(self) -> ForwardingService:
        return self.running[0].service

    @property
    def here(self) -> Connection:
        return self.running[0].here

    @property
    def uplink(self) -> Connection:
        return self.running[0].uplink

    def start(self, service: str = "", *, broker: Hub | None = None, **section: Any) -> Running:
        """Start a service; its sides may be away. ``broker``: on its remote side, if that is another one."""
        self._broker = broker or self.remote_hub
        here = Connection("here", self.local_hub, self)
        here.as_published = self.as_published
        made = SERVICES[service or self.name](self._config(section), here, clock=lambda: self.now)
        first = self.connections.index(here) + 1
        self.running.append(Running(made, here, *[*self.connections[first:], None][:2]))
        made.set_up()
        return self.running[-1]

    def stop(self) -> None:
        _, *connections = self.running.pop()
        for connection in filter(None, connections):
            connection.close()
            self.connections.remove(connection)

    @property
    def stops(self) -> Connection:
        found = self.running[0].stops
        assert found is not None
        return found

    def run(self, seconds: float = 3.0) -> None:
        """Let everything happen that is due by then."""
        end = self.now + seconds
        while True:
            self._rest()
            due = min((one.timers.next_due for one in self._services()), default=inf)
            if due > end:
                break
            self.now = max(self.now, due)
        self.now = end

    def interruptions(self) -> dict[str, Callable[[], object]]:
        """What a service meets, by the words of histories."""
        return {
            "stop": self.stop,
            "cut": lambda: self.uplink.cut(),
            "mend": lambda: self.uplink.mend(),
            "away": lambda: self.here.cut(),
            "back": lambda: self.here.mend(),
            "local-forgets": lambda: (self.local_hub.stop(forget=True), self.run(1), self.local_hub.start()),
            "remote-forgets": lambda: (self.remote_hub.stop(forget=True), self.run(1), self.remote_hub.start()),
            "save": lambda: self.saved.update({hub: dict(hub.retained) for hub in (self.local_hub, self.remote_hub)}),
            "local-restored": lambda: self._restore(self.local_hub),
            "local-restored-late": lambda: self._restore(self.local_hub, after_s=RESTORED_S + 1),
            "remote-restored": lambda: self._restore(self.remote_hub),
        }

    def _restore(self, hub: Hub, after_s: float = 1.0) -> None:
        """It ends, and starts again with what it had at the last save; nobody knows who had published that."""
        hub.stop(forget=True)
        self.run(after_s)
        hub.retained.update(self.saved[hub])
        hub.publishers.update(dict.fromkeys(hub.retained, Connection("somebody", hub, self)))
        hub.start()

    def retained(self, suffix: str) -> tuple[bytes | None, bytes | None]:
        """What both sides retain: local, remote."""
        topic = f"{self.local.base}/{suffix}"
        local, remote = self.local_hub.retained.get(topic), self.remote_hub.retained.get(topic)
        return local and local.payload, remote and remote.payload

    def _services(self) -> Iterator[ForwardingService]:
        return (one.service for one in self.running)

    def _rest(self) -> None:
        for _ in range(100_000):
            worked = [connection.work() for connection in self.connections]
            for service in self._services():
                due = service.timers.next_due <= self.now
                worked.append(service.turn(0) or due)
            if not any(worked):
                return
        raise AssertionError("messages do not come to rest")

    def _config(self, section: dict[str, Any]) -> Config:
        if self.name == "bridge":
            return make_config(**section)
        services = {"mqtt_bridge": {"remote_mqtt": {"host": "127.0.0.1"}, **section}}
        transport = {"kind": "zenoh", "mqtt_mirror": {"host": "127.0.0.1"}}
        raw = {"robot": {"id": "rover"}, "transport": transport, "services": services}
        return parse(raw, folder=Path.cwd(), env={})

    def _stops(self, config: Config) -> Connection | None:
        return None if config.security.level == "open" else Connection("stops", self._broker, self)

    def _uplink(self, *_arguments: Any, will: Message | None = None) -> Connection:
        uplink = Connection("uplink", self._broker, self, will=will)
        uplink.as_published = self.as_published
        return uplink
