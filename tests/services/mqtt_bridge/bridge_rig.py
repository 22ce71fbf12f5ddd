"""A bridge in this process between two transports, with a client on each that stands for all other programs."""

from __future__ import annotations

import itertools
import os
import threading
import time
from pathlib import Path
from typing import Any, cast

import pytest

from pebble.config import Config, parse
from pebble.forwarding.routing import Side
from pebble.forwarding.side import Gate
from pebble.runtime.connections import local_transport
from pebble.service import Service
from pebble.services.mqtt_bridge import service as bridge_module
from pebble.services.mqtt_bridge.service import MqttBridge
from pebble.transports import Message, MqttSettings, QoS, State, Transport, ZenohSettings, create
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.support import until

BASE = "pebble/robots/rover"
_numbers = itertools.count(1)


def make_config(
    robot: str = "rover",
    local_mqtt: dict[str, Any] | None = None,
    av_daemon: dict[str, Any] | None = None,
    transport: dict[str, Any] | None = None,
    **bridge: Any,
) -> Config:
    """A robot with a bridge; further keywords are keys of services.mqtt_bridge."""
    raw = {
        "robot": {"id": robot},
        **({} if transport is None else {"transport": transport}),
        "local_mqtt": local_mqtt or {},
        "services": {
            "av_daemon": av_daemon or {},
            "mqtt_bridge": {"enabled": True, "remote_mqtt": {"host": "127.0.0.1"}, **bridge},
        },
    }
    return parse(raw, folder=Path.cwd(), env={"XDG_STATE_HOME": os.environ["XDG_STATE_HOME"]})


class Client:
    """A client on one side, and the messages of others that it has received below the robot's base.

    ``probes`` are those by which bridges look for cycles; for programs they are nothing, or a value once more.
    """

    def __init__(self, transport: Transport, base: str = BASE, *, listen: bool = True) -> None:
        self.transport, self.base = transport, base
        self.seen: list[Message] = []
        self.probes: list[Message] = []
        transport.open(10)
        assert transport.state is State.CONNECTED, transport.problem
        if listen:
            transport.subscribe(f"{base}/#", self._remember, echo=False, direct=True)

    def publish(
        self, suffix: str, payload: bytes, *, qos: int = 1, retain: bool = False, remember: bool = True
    ) -> None:
        """``remember`` False: it is not published again at the next connection."""
        topic = f"{self.base}/{suffix}"

        def accepted() -> bool:
            return self.transport.publish(topic, payload, qos=QoS(qos), retain=retain, remember=remember)

        assert until(accepted), self.transport.problem

    def on(self, suffix: str) -> list[Message]:
        return [message for message in list(self.seen) if message.topic == f"{self.base}/{suffix}"]

    def payloads(self, suffix: str) -> list[bytes]:
        return [message.payload for message in self.on(suffix)]

    def _remember(self, message: Message) -> None:
        (self.probes if is_probe(message.payload) else self.seen).append(message)


def is_probe(payload: bytes) -> bool:
    """Whether white space that encodes a number ends the payload, or is all of it."""
    return payload[-24:].isspace() and len(payload) >= 24


class Running:
    """A service on a thread of its own, as its process would run it."""

    def __init__(self, service: Service) -> None:
        self.service = service
        self._thread = threading.Thread(target=service.run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self.service.quit()
        self._thread.join(10)
        assert not self._thread.is_alive(), "the service does not end"


class Uplink:
    """A hub as one client sees it through a connection that can be cut; the connections of others stay."""

    def __init__(self, hub: MemoryHub) -> None:
        self._hub = hub
        self._cuts, self._whole = 0, True

    def __getattr__(self, name: str) -> Any:
        return getattr(self._hub, name)

    @property
    def era(self) -> tuple[int, int] | None:
        return (self._hub.era, self._cuts) if self._whole and self._hub.era is not None else None

    def cut(self) -> None:
        self._turn(whole=False)

    def mend(self) -> None:
        self._turn(whole=True)

    def _turn(self, *, whole: bool) -> None:
        with self._hub.lock:
            self._whole, self._cuts = whole, self._cuts + 1
            self._hub._wake_all()


class MemoryRig:
    """Two hubs (or twice the same one), a client on each, and any number of bridges one after another."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, one: bool = False, base: str = BASE) -> None:
        self.local_hub = MemoryHub()
        self.remote_hub = self.local_hub if one else MemoryHub()
        self.local = Client(MemoryTransport("someone-local", self.local_hub), base)
        self.remote = Client(MemoryTransport("operator", self.remote_hub), base)
        self.uplink = Uplink(self.remote_hub)
        self.robot_side: MemoryTransport
        self.operator_side: MemoryTransport
        self._running: list[Running] = []
        monkeypatch.setattr(bridge_module, "remote_transport", self._remote_transport)

    def bridge(self, *, ready: bool = True, **section: Any) -> MqttBridge:
        """Start a bridge that listens; ``ready`` waits until it forwards, or has found out that it must not."""
        self.robot_side = MemoryTransport("local-bridge", self.local_hub)
        bridge = MqttBridge(make_config(**section), self.robot_side)
        self._running.append(Running(bridge))
        assert until(lambda: Side.LOCAL in bridge.status.subscribed), "the bridge does not listen"
        if ready:
            self.wait_ready(bridge)
        return bridge

    def cut(self) -> None:
        """The bridge loses its uplink, and has noticed."""
        self.uplink.cut()
        assert until(lambda: self.operator_side.state is State.CONNECTING)

    def taken(self) -> int:
        """How many messages of the local side the bridge has dealt with."""
        return self.robot_side.counters["delivered"]

    def wait_ready(self, bridge: MqttBridge) -> None:
        assert until(lambda: gate_of(bridge) is not Gate.WAITING), "the bridge never made up its mind"
        if gate_of(bridge) is Gate.OPEN:
            assert until(lambda: Side.REMOTE in bridge.status.subscribed)

    def stop_bridges(self) -> None:
        while self._running:
            self._running.pop().stop()

    def close(self) -> None:
        self.stop_bridges()
        self.local.transport.close()
        self.remote.transport.close()

    def _remote_transport(self, _config: Config, name: str, *, will: Message | None = None) -> MemoryTransport:
        self.operator_side = MemoryTransport(name, cast(MemoryHub, self.uplink), will=will)
        return self.operator_side


class MqttRig:
    """The same over real brokers: the bridge as its process would make it, clients that are no clients of ours."""

    def __init__(
        self,
        local: dict[str, Any] | ZenohSettings,
        remote: dict[str, Any],
        *,
        uplink: int | None = None,
        **section: Any,
    ) -> None:
        """``local``: where the robot's broker is, or its hub; ``uplink``: a port of the remote one, for the bridge."""
        robot = f"r{next(_numbers)}"
        self.base = f"pebble/robots/{robot}"
        remote_mqtt = {**remote, "port": uplink or remote["port"]}
        if isinstance(local, ZenohSettings):
            section["transport"] = {"kind": "zenoh", "run_dir": str(local.run_dir)}
        self._config = make_config(
            robot, None if isinstance(local, ZenohSettings) else local, remote_mqtt=remote_mqtt, **section
        )
        self._where: tuple[dict[str, Any] | ZenohSettings, dict[str, Any]] = (local, remote)
        self._clients: list[Client] = []
        self._running: Running | None = None
        self.bridge: MqttBridge
        self.local, self.remote = self.client("local"), self.client("remote")

    def client(self, side: str, *, listen: bool = True) -> Client:
        """A client on that side. It does not receive its own messages."""
        where = self._where[side == "remote"]
        name = f"{self.base}-{side}-{len(self._clients)}"
        if isinstance(where, ZenohSettings):
            transport = create("zenoh", name.rpartition("/")[2], where)
        else:
            transport = create("mqtt", name, MqttSettings(**{**where, "as_published": True}))
        client = Client(transport, self.base, listen=listen)
        self._clients.append(client)
        return client

    def start(self, *, ready: bool = True) -> MqttBridge:
        self.bridge = MqttBridge(self._config, local_transport(self._config, "local-bridge", as_published=True))
        self._running = Running(self.bridge)
        if ready:
            self.wait_ready()
        return self.bridge

    def wait_ready(self) -> None:
        bridge = self.bridge
        assert until(lambda: gate_of(bridge) is not Gate.WAITING), "the bridge never made up its mind"
        if gate_of(bridge) is Gate.OPEN:
            assert until(lambda: len(bridge.status.synchronized) == 2)

    def retained(self, side: str) -> dict[str, bytes]:
        """What a late subscriber finds on that side."""
        late = self.client(side)
        Quiet(late).wait(0.2)
        late.transport.close()
        retained = {m.topic.removeprefix(f"{self.base}/"): m.payload for m in late.seen if m.retain}
        return {suffix: payload for suffix, payload in retained.items() if suffix != "outgoing/online"}

    def stop(self) -> None:
        if self._running is not None:
            self._running.stop()
            self._running = None

    def close(self) -> None:
        self.stop()
        for client in self._clients:
            client.transport.close()


def gate_of(bridge: MqttBridge) -> Gate:
    return bridge.status.gate


class Quiet:
    """Waits until nothing new has arrived for a while."""

    def __init__(self, *clients: Client) -> None:
        self._clients = clients

    def wait(self, seconds: float = 0.3, timeout: float = 10.0) -> None:
        """Until no client has seen anything but heartbeats for ``seconds``: a loop never lets it return."""
        end = time.monotonic() + timeout
        before, since = self._count(), time.monotonic()
        while time.monotonic() - since < seconds:
            assert time.monotonic() < end, "messages do not come to rest"
            time.sleep(0.01)
            now = self._count()
            if now != before:
                before, since = now, time.monotonic()

    def _count(self) -> int:
        return sum(not m.topic.endswith("/online") for client in self._clients for m in list(client.seen))
