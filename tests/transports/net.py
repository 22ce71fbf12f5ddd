"""A network and its clients, as the shared transport suite uses them: one `Net` per kind of transport.

A `Net` owns the broker or hub (or a Python object) and every client a test makes. The network
runs as long as a module's tests of one kind; `close_clients` ends what one test made. Tests keep apart by topic.
"""

from __future__ import annotations

import sys
import tomllib
from abc import ABC, abstractmethod
from collections.abc import Callable
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, ClassVar

from pebble.transports import GROUP, Message, MqttSettings, QoS, State, Transport, create
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.support import ROOT, WAIT_S, Broker, until
from tests.transports.forked import Forked


class Net(ABC):
    """What the suite needs from a kind of transport. A subclass supplies `kind`, `settings` and the network."""

    #: What `pebble.transports.create` calls it.
    kind: str

    def __init__(self) -> None:
        self._clients: list[Transport] = []
        self._peers: list[Any] = []

    # -- to supply

    @abstractmethod
    def settings(self, **changes: Any) -> Any:
        """Settings of a client, changed by keyword (the settings class's field names); they must pickle."""

    @abstractmethod
    def start_network(self) -> None:
        """Start the broker or hub (again): same address, what it had saved is there again."""

    @abstractmethod
    def stop_network(self, *, forget: bool = False) -> None:
        """SIGKILL the broker or hub, once its data is saved; `forget` then deletes that."""

    @abstractmethod
    def freeze_network(self) -> None:
        """It stops answering without closing a connection (SIGSTOP)."""

    @abstractmethod
    def thaw_network(self) -> None: ...

    #: Changes to settings of a client whose `echo=False` is exact (T16).
    echoless: ClassVar[dict[str, Any]] = {}
    #: Changes to settings of a client that is not to count the network as silent while this machine is busy.
    patient: ClassVar[dict[str, Any]] = {}

    @abstractmethod
    def heal(self) -> None:
        """After a test that failed half-way: make the network run again. Does nothing if it runs."""

    # -- what tests call

    def client(self, name: str, *, will: Message | None = None, opened: bool = True, **changes: Any) -> Transport:
        """A client in this process; `opened` waits for the connection and fails the test without one."""
        client = create(self.kind, name, self.settings(**changes), will=will)
        self._clients.append(client)
        if opened:
            client.open(WAIT_S)
            assert client.state is State.CONNECTED, client.problem
        return client

    def peer(self, name: str, *, will: Message | None = None) -> Any:
        """A connected client that can be killed: in its own process where the network is real."""
        peer = ProcessPeer(self.kind, name, self.settings(), will)
        self._peers.append(peer)
        return peer

    def restart_network(self, *, forget: bool = False) -> None:
        self.stop_network(forget=forget)
        self.start_network()

    def close_clients(self) -> None:
        """End every client and peer made so far."""
        for peer in self._peers:
            peer.kill()
        self._peers.clear()
        for client in self._clients:
            client.close()
        self._clients.clear()

    def stop(self) -> None:
        """End everything, the network included."""
        self.close_clients()
        self.stop_network()


class ProcessPeer:
    """A client in a process of its own (:func:`main`), which does one thing after the other."""

    def __init__(self, kind: str, name: str, settings: Any, will: Message | None) -> None:
        self._pipe, theirs = Pipe()
        self._process = Forked("tests.transports.net", kind, name, settings, will, theirs)
        theirs.close()
        assert self._pipe.recv() is True, "the peer did not connect"
        self.pid = self._process.pid

    def publish(self, topic: str, payload: bytes, *, qos: QoS = QoS.DELIVERED, retain: bool = False) -> bool:
        return bool(self._ask("publish", topic, payload, qos=qos, retain=retain))

    def listen(self) -> None:
        """Subscribe to everything."""
        self._ask("listen")

    def heard(self) -> Any:
        """Return how many messages it has received, and the text of the last one."""
        return self._ask("heard")

    def kill(self) -> None:
        self._process.kill()
        self._process.wait(WAIT_S)

    def close(self) -> None:
        self._ask("close")
        self._process.wait(WAIT_S)

    def _ask(self, what: str, *arguments: Any, **options: Any) -> Any:
        self._pipe.send((what, arguments, options))
        return self._pipe.recv()


def main(kind: str, name: str, settings: Any, will: Message | None, pipe: Connection) -> None:
    """Do what comes through ``pipe``, and answer."""
    client, received = create(kind, name, settings, will=will).open(10), list[Message]()
    does: dict[str, Callable[..., Any]] = {
        "publish": client.publish,
        "listen": lambda: client.subscribe("#", received.append) and None,
        "heard": lambda: [len(received), received[-1].payload.decode() if received else ""],
        "close": client.close,
    }
    pipe.send(client.state is State.CONNECTED)
    while client.state is not State.CLOSED:
        what, arguments, options = pipe.recv()
        pipe.send(does[what](*arguments, **options))


class Received:
    """A handler that remembers: call it with messages; look at what came."""

    def __init__(self) -> None:
        self.messages: list[Message] = []

    def __call__(self, message: Message) -> None:
        self.messages.append(message)

    @property
    def payloads(self) -> list[bytes]:
        return [message.payload for message in self.messages]

    def until(self, *payloads: bytes, timeout: float = WAIT_S) -> bool:
        """Have exactly these payloads arrived, in this order?"""
        return until(lambda: self.payloads == list(payloads), timeout)


class MemoryNet(Net):
    kind = "memory"

    def __init__(self) -> None:
        super().__init__()
        self._hub = MemoryHub()

    def settings(self, **_changes: Any) -> Any:
        return self._hub

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
    echoless: ClassVar[dict[str, Any]] = {"as_published": True}
    patient: ClassVar[dict[str, Any]] = {"silence_s": 20.0}

    def __init__(self, folder: Path, protocol: str) -> None:
        super().__init__()
        self._protocol = protocol
        self._broker = Broker(folder, persistence=True)

    def settings(self, **changes: Any) -> Any:
        settings = {"host": "127.0.0.1", "port": self._broker.port, "protocol": self._protocol, **changes}
        return MqttSettings(**settings)

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
