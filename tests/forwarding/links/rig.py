"""A bridge or a mirror between real brokers and hubs."""

from __future__ import annotations

from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

from pebble.config import Config, parse
from pebble.forwarding.routing import Side
from pebble.forwarding.service import ForwardingService
from pebble.forwarding.side import Gate
from pebble.runtime.connections import local_transport
from pebble.transports import MqttSettings, State, Transport, ZenohSettings, create
from tests.forwarding.virtual import SERVICES
from tests.services.mqtt_bridge.bridge_rig import Client, Quiet, Running, make_config
from tests.support import AmqttBroker, Broker, free_port, until
from tests.tcp_proxy import TcpProxy
from tests.transports.zenoh_net import HubProcess

LOCAL, REMOTE = Side.LOCAL, Side.REMOTE
_numbers = count(1)


class MqttEnd:
    """A mosquitto, or another broker of a test's own, and a way to it for the service.

    An end can lose what it retains, or get an older save back.
    """

    def __init__(
        self, folder: Path, protocol: str = "3.1.1", *, keeps: bool = False, broker: Broker | AmqttBroker | None = None
    ) -> None:
        self.broker = broker or Broker(folder, persistence=keeps)
        self.link = TcpProxy(self.broker.port)
        self.section: dict[str, Any] = {"host": "127.0.0.1", "port": self.link.port, "protocol": protocol}
        self._saved: dict[Path, bytes] = {}

    def transport(self, name: str) -> Transport:
        return create("mqtt", name, MqttSettings(**{**self.section, "port": self.broker.port, "as_published": True}))

    def stop(self) -> None:
        assert isinstance(self.broker, Broker)
        self.broker.kill()

    def save(self) -> None:
        assert isinstance(self.broker, Broker)
        self.broker.save()
        self._saved = {file: file.read_bytes() for file in self.broker.store.glob("*.db")}  # not a half-written .new

    def restore(self) -> None:
        """Start again, with what was there at the last :meth:`save`; without one with nothing."""
        for file, data in self._saved.items():
            file.write_bytes(data)
        self.broker.start()

    def close(self) -> None:
        self.link.stop()
        self.broker.stop()


class ZenohEnd:
    """A hub; ``uplink``: which operators reach over the network."""

    section: dict[str, Any]  # of a config

    def __init__(self, folder: Path, *, keeps: bool = False, uplink: bool = False) -> None:
        self._journal = folder / "journal" if keeps else None
        self._hub = HubProcess(folder / ("uplink" if uplink else "run"), self._journal)
        # a machine that stands still for the usual two seconds would make live messages late, and they would be dropped
        settings = replace(self._hub.settings, lease_ms=5000)
        if uplink:
            endpoint = f"tcp/127.0.0.1:{free_port()}"
            self._hub.settings = replace(settings, listen=(endpoint,))
            settings = ZenohSettings(run_dir=folder / "operators", connect=(endpoint,), client=True, lease_ms=5000)
            self.section = {"kind": "zenoh", "connect": [endpoint]}
        else:
            self.section = {"kind": "zenoh", "run_dir": str(settings.run_dir), "lease_ms": settings.lease_ms}
        self._settings = settings
        self._hub.start()

    def transport(self, name: str) -> Transport:
        return create("zenoh", name, self._settings)

    def stop(self) -> None:
        self._hub.kill()

    def save(self) -> None:
        assert self._journal is not None
        self._hub.wait_until_stored()
        self._saved = self._journal.read_bytes()

    def restore(self) -> None:
        if self._journal is not None:
            self._journal.write_bytes(self._saved)
        self._hub.start()

    def close(self) -> None:
        if self._hub.running:
            self._hub.end()


End = MqttEnd | ZenohEnd


class Rig:
    """Both ends, a client on each that is no client of the service, and the service in between."""

    def __init__(self, service: str, local: End, remote: End, *, robot: str = "", **section: Any) -> None:
        """``section``: further keys of services.mqtt_bridge."""
        self.name, self.robot = service, robot or f"r{next(_numbers)}"
        self.base = f"pebble/robots/{self.robot}"
        self.ends: dict[Side, End] = {LOCAL: local, REMOTE: remote}
        self.config = self._parse(local.section, remote.section, section)
        self._clients: list[Client] = []
        self._running: Running | None = None
        self.service: ForwardingService
        self.local, self.remote = self.client(LOCAL), self.client(REMOTE)

    @property
    def clients(self) -> dict[Side, Client]:
        return {LOCAL: self.local, REMOTE: self.remote}

    @property
    def gate(self) -> Gate:
        return self.service.status.gate

    def client(self, side: Side) -> Client:
        """One more on that side; none receives its own messages."""
        transport = self.ends[side].transport(f"{self.robot}-{side.value}-{len(self._clients)}")
        self._clients.append(Client(transport, self.base))
        return self._clients[-1]

    def start(self, *, ready: bool = True) -> ForwardingService:
        made = SERVICES[self.name]
        self.service = made(self.config, local_transport(self.config, made.client_name, as_published=True))
        self._running = Running(self.service)
        if ready:
            self.wait_ready()
        return self.service

    def wait_ready(self) -> None:
        """Until the service forwards, or has found out that it must not."""
        assert until(lambda: self.gate is not Gate.WAITING), "it never made up its mind"
        assert until(lambda: self.gate is Gate.SHUT or self.synchronized)

    @property
    def synchronized(self) -> bool:
        return self.service.status.synchronized == {*Side}

    def transport(self, side: Side) -> Transport:
        """The service's own."""
        return {LOCAL: self.service.transport, REMOTE: self.service.remote}[side]

    def connections(self, side: Side) -> int:
        """How many connections of the service there have been; the newest one is subscribed to again."""
        return self.transport(side).counters["connected"] * (self.transport(side).state is State.CONNECTED)

    def retained(self, side: Side) -> dict[str, bytes]:
        """What a late subscriber finds on that side, but what the bridge itself publishes there."""
        late = self.client(side)
        Quiet(late).wait(0.2)
        late.transport.close()
        retained = {m.topic.removeprefix(f"{self.base}/"): m.payload for m in late.seen if m.retain}
        return {suffix: payload for suffix, payload in retained.items() if suffix != "outgoing/online"}

    def after_all(self, speaker: Side) -> None:
        """Wait until earlier messages of the client on that side have passed, if they do."""
        listener = self.clients[speaker.other]
        mark = b'{"b": %d}' % len(listener.seen)
        self.clients[speaker].publish("incoming/lights-solid", mark)
        assert until(lambda: mark in listener.payloads("incoming/lights-solid"))

    def stop(self) -> None:
        if self._running is not None:
            self._running.stop()
            self._running = None

    def close(self) -> None:
        self.stop()
        for client in self._clients:
            client.transport.close()

    def _parse(self, local: dict[str, Any], remote: dict[str, Any], section: dict[str, Any]) -> Config:
        if self.name == "bridge":
            own = {"transport" if "kind" in local else "local_mqtt": local}
            other = {"remote" if "kind" in remote else "remote_mqtt": remote}
            return make_config(self.robot, **{**own, **other, **section})
        # beside a bridge, as on any robot: it looks first whether they share a broker
        bridge = {"enabled": True, "remote_mqtt": {"host": "127.0.0.1"}, **section}
        raw = {"robot": {"id": self.robot}, "transport": {**local, "mqtt_mirror": remote}}
        return parse({**raw, "services": {"mqtt_bridge": bridge}}, folder=Path.cwd(), env={})
