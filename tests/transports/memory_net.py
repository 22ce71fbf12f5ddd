"""The network inside this process, for the shared suite."""

from __future__ import annotations

from typing import Any

from pebble.transports import Message, QoS, State
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.transports.net import Net, Peer


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

    def peer(self, name: str, *, will: Message | None = None) -> Peer:
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
