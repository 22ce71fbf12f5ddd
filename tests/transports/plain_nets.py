"""The network inside this process, and a real mosquitto on a free port, for the shared suite."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path
from typing import Any, ClassVar

from pebble.transports import GROUP, Message, MqttSettings, QoS, State
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.support import ROOT, Broker
from tests.transports.net import Net


class MemoryNet(Net):
    kind = "memory"

    def __init__(self) -> None:
        super().__init__()
        self._hub = MemoryHub()

    def settings(self, **_changes: Any) -> Any:
        return self._hub

    def portable_settings(self) -> Any:
        return MemoryHub()

    def start_network(self) -> None:
        self._hub.start()

    def stop_network(self, *, forget: bool = False) -> None:
        self._hub.stop(forget=forget)

    def freeze_network(self) -> None:
        """There is no connection that could stay open without answering: an outage is all there can be."""
        self._hub.stop()

    def thaw_network(self) -> None:
        self._hub.start()

    def heal(self) -> None:
        if self._hub.era is None:
            self._hub.start()

    def peer(self, name: str, *, will: Message | None = None) -> Any:
        client = self.client(name, will=will)
        assert isinstance(client, MemoryTransport)
        return MemoryPeer(self._hub, client)


class MemoryPeer:
    """Dies by being forgotten."""

    def __init__(self, hub: MemoryHub, client: MemoryTransport) -> None:
        self._hub, self._client = hub, client

    def publish(self, topic: str, payload: bytes, *, qos: QoS = QoS.DELIVERED, retain: bool = False) -> bool:
        return self._client.publish(topic, payload, qos=qos, retain=retain)

    def kill(self) -> None:
        if self._client.state is not State.CLOSED:
            self._hub.crash(self._client)

    def close(self) -> None:
        self._client.close()


class MqttNet(Net):
    kind = "mqtt"
    patient: ClassVar[dict[str, Any]] = {"silence_s": 20.0}

    def __init__(self, folder: Path, protocol: str) -> None:
        super().__init__()
        self._protocol = protocol
        self._broker = Broker(folder, persistence=True)

    def settings(self, **changes: Any) -> Any:
        settings = {"host": "127.0.0.1", "port": self._broker.port, "protocol": self._protocol, **changes}
        return MqttSettings(**settings)

    def echoless_settings(self) -> Any:
        return self.settings(as_published=True)

    def start_network(self) -> None:
        if not self._broker.running:
            self._broker.start()

    def stop_network(self, *, forget: bool = False) -> None:
        if self._broker.running:
            self._broker.save()
            self._broker.kill()
        if forget:
            self._broker.forget()

    def freeze_network(self) -> None:
        self._broker.freeze()

    def thaw_network(self) -> None:
        self._broker.thaw()

    def heal(self) -> None:
        if self._broker.running:
            self._broker.thaw()
        else:
            self._broker.start()

    def stop(self) -> None:
        self.close_clients()
        self._broker.kill()


class PahoNet(MqttNet):
    """The same broker, and the transport of the extension, found as that of a package that is installed."""

    kind = "paho"

    def __init__(self, folder: Path, protocol: str) -> None:
        super().__init__(folder, protocol)
        points = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"][GROUP]
        self._offers = folder / "offers"
        package = self._offers / "extension-1.dist-info"
        package.mkdir(parents=True)
        (package / "METADATA").write_text("Name: extension\nVersion: 1\n")
        (package / "entry_points.txt").write_text(f"[{GROUP}]\npaho = {points['paho']}\n")
        sys.path.append(str(self._offers))

    def stop(self) -> None:
        super().stop()
        sys.path.remove(str(self._offers))
