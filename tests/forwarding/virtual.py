"""Bridge or mirror in virtual time, between two networks in memory: nothing runs but by :meth:`World.run`."""

from __future__ import annotations

from math import inf
from pathlib import Path
from typing import Any

import pytest

from pebble.config import parse
from pebble.forwarding.service import ForwardingService
from pebble.services import mqtt_mirror as mirror_module
from pebble.services.mqtt_bridge import service as bridge_module
from pebble.services.mqtt_bridge.service import MqttBridge
from pebble.services.mqtt_mirror import MqttMirror
from pebble.transports import Message
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
        self._away = False
        world.connections.append(self)

    def cut(self) -> None:
        self._away = True

    def mend(self) -> None:
        self._away = False

    def work(self) -> bool:
        """Do one thing, if there is one to do."""
        if self._stopping or not (self._inbox or self._attached != self._reachable):
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
        return not self._away and super()._present

    def _open(self, timeout: float) -> None:
        self._stopping = False
        self._hub.enter(self)
        while timeout and self.work():
            pass


class World:
    """Two sides with a client on each, and a service between them that can be restarted."""

    def __init__(self, service: str, monkeypatch: pytest.MonkeyPatch, *, one: bool = False) -> None:
        self.name = service
        self.now = 100.0
        self.connections: list[Connection] = []
        self.local_hub = Hub()
        self.remote_hub = self.local_hub if one else Hub()
        self.local = Client(Connection("someone-local", self.local_hub, self))
        self.remote = Client(Connection("operator", self.remote_hub, self))
        self.here: Connection  # the service's own, on the robot's side
        self.uplink: Connection
        self.service: ForwardingService | None = None
        monkeypatch.setattr(bridge_module, "remote_transport", self._uplink)
        monkeypatch.setattr(mirror_module, "mirror_transport", self._uplink)

    def start(self, **section: Any) -> None:
        """Start the service; its sides may be away."""
        self.here = Connection("here", self.local_hub, self)
        config = make_config(**section)
        if self.name == "mirror":
            raw = {"robot": {"id": "rover"}, "transport": {"kind": "zenoh", "mqtt_mirror": {"host": "127.0.0.1"}}}
            config = parse(raw, folder=Path.cwd(), env={})
        self.service = SERVICES[self.name](config, self.here, clock=lambda: self.now)
        self.service.set_up()

    def stop(self) -> None:
        assert self.service is not None
        self.service = None
        for connection in (self.here, self.uplink):
            connection.close()
            self.connections.remove(connection)

    def run(self, seconds: float = 3.0) -> None:
        """Let everything happen that is due by then."""
        end = self.now + seconds
        while True:
            self._rest()
            due = inf if self.service is None else self.service.timers.next_due
            if due > end:
                break
            self.now = max(self.now, due)
        self.now = end

    def retained(self, suffix: str) -> tuple[bytes | None, bytes | None]:
        """What both sides retain: local, remote."""
        topic = f"{self.local.base}/{suffix}"
        local, remote = self.local_hub.retained.get(topic), self.remote_hub.retained.get(topic)
        return local and local.payload, remote and remote.payload

    def _rest(self) -> None:
        for _ in range(100_000):
            worked = [connection.work() for connection in self.connections]
            if self.service is not None:
                due = self.service.timers.next_due <= self.now
                worked += [self.service.turn(0) or due]
            if not any(worked):
                return
        raise AssertionError("messages do not come to rest")

    def _uplink(self, *_arguments: Any, will: Message | None = None) -> Connection:
        self.uplink = Connection("uplink", self.remote_hub, self, will=will)
        return self.uplink
