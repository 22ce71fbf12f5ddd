"""A bridge in this process between two transports, with a client on each that stands for all other programs."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path
from typing import Any

import pytest

from pebble.config import Config, parse
from pebble.forwarding.side import Gate
from pebble.services.mqtt_bridge import service as bridge_module
from pebble.services.mqtt_bridge.service import MqttBridge
from pebble.transports import Message, QoS, State, Transport
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.kit.robot import Running as Running
from tests.support import WAIT_S, until

BASE = "pebble/robots/rover"


def make_config(
    robot: str = "rover",
    local_mqtt: dict[str, Any] | None = None,
    av_daemon: dict[str, Any] | None = None,
    transport: dict[str, Any] | None = None,
    security: dict[str, Any] | None = None,
    serial: dict[str, Any] | None = None,
    **bridge: Any,
) -> Config:
    """A robot with a bridge; further keywords are keys of services.mqtt_bridge."""
    raw = {
        "robot": {"id": robot},
        **({} if transport is None else {"transport": transport}),
        **({} if security is None else {"security": security}),
        "local_mqtt": local_mqtt or {},
        "services": {
            "av_daemon": av_daemon or {},
            "serial_mcu_bridge": serial or {},
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
        transport.open(WAIT_S)
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


class MemoryRig:
    """Two hubs, a client on each, and a bridge, each with threads of its own as in a robot."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.local_hub, self.remote_hub = MemoryHub(), MemoryHub()
        self.local = Client(MemoryTransport("someone-local", self.local_hub))
        self.remote = Client(MemoryTransport("operator", self.remote_hub))
        self.robot_side: MemoryTransport
        self._running: list[Running] = []
        remote = lambda _config, name, *, will=None: MemoryTransport(name, self.remote_hub, will=will)  # noqa: E731
        monkeypatch.setattr(bridge_module, "remote_transport", remote)
        monkeypatch.setenv("XDG_STATE_HOME", tempfile.mkdtemp(dir=os.environ["XDG_STATE_HOME"]))  # an audit of its own

    def bridge(self, **section: Any) -> MqttBridge:
        """Start a bridge, and wait until it forwards."""
        self.robot_side = MemoryTransport("local-bridge", self.local_hub)
        bridge = MqttBridge(make_config(**section), self.robot_side)
        self._running.append(Running(bridge))
        assert until(lambda: bridge.forwarder.gate is Gate.OPEN and all(bridge.subscriptions.values()))
        return bridge

    def close(self) -> None:
        while self._running:
            self._running.pop().stop()
        self.local.transport.close()
        self.remote.transport.close()


class Quiet:
    """Waits until nothing new has arrived for a while."""

    def __init__(self, *clients: Client) -> None:
        self._clients = clients

    def wait(self, seconds: float = 0.3, timeout: float = WAIT_S) -> None:
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
