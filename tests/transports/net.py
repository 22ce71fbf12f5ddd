"""A network and its clients, as the shared transport suite uses them: one `Net` per kind of transport.

A `Net` owns the broker or hub (or a Python object) and every client a test makes. The network
runs as long as a module's tests of one kind; `close_clients` ends what one test made. Tests keep apart by topic.
"""

from __future__ import annotations

import base64
import json
import pickle
from abc import ABC, abstractmethod
from typing import Any, ClassVar

from pebble.transports import Message, QoS, State, Transport, create
from tests.support import WAIT_S, until
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
        """Settings of a client, changed by keyword (the settings class's field names)."""

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

    def echoless_settings(self) -> Any:
        """Settings of a client whose `echo=False` is exact (T16)."""
        return self.settings()

    #: Changes to settings of a client that is not to count the network as silent while this machine is busy.
    patient: ClassVar[dict[str, Any]] = {}

    @abstractmethod
    def heal(self) -> None:
        """After a test that failed half-way: make the network run again. Does nothing if it runs."""

    def portable_settings(self) -> Any:
        """Settings a program of its own can use; they must pickle."""
        return self.settings()

    # -- what tests call

    def client(self, name: str, *, will: Message | None = None, opened: bool = True, **changes: Any) -> Transport:
        """A client in this process; `opened` waits for the connection and fails the test without one."""
        return self._client(name, self.settings(**changes), will, opened)

    def echoless_client(self, name: str) -> Transport:
        return self._client(name, self.echoless_settings(), None, True)

    def peer(self, name: str, *, will: Message | None = None) -> Any:
        """A connected client that can be killed: in its own process where the network is real."""
        peer = ProcessPeer(self.kind, name, self.portable_settings(), will)
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

    def _client(self, name: str, settings: Any, will: Message | None, opened: bool) -> Transport:
        client = create(self.kind, name, settings, will=will)
        self._clients.append(client)
        if opened:
            client.open(WAIT_S)
            assert client.state is State.CONNECTED, client.problem
        return client


class ProcessPeer:
    """Runs tests/transports/peer.py and talks to it in lines of JSON."""

    def __init__(self, kind: str, name: str, settings: Any, will: Message | None) -> None:
        recipe = base64.b64encode(pickle.dumps((kind, name, settings, will))).decode()
        self._process = Forked("tests.transports.peer", recipe)
        assert self._answer() is True, "the peer did not connect"
        self.pid = self._process.pid

    def publish(self, topic: str, payload: bytes, *, qos: QoS = QoS.DELIVERED, retain: bool = False) -> bool:
        return bool(self._ask({"topic": topic, "payload": payload.hex(), "qos": int(qos), "retain": retain}))

    def listen(self) -> None:
        """Subscribe to everything."""
        self._ask({"listen": True})

    def heard(self) -> Any:
        """Return how many messages it has received, and the text of the last one."""
        return self._ask({"heard": True})

    def kill(self) -> None:
        self._process.kill()
        self._process.wait(WAIT_S)
        self._release()

    def close(self) -> None:
        self._ask({"close": True})
        self._process.wait(WAIT_S)
        self._release()

    def _ask(self, request: dict[str, Any]) -> Any:
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        return self._answer()

    def _answer(self) -> Any:
        line = self._process.stdout.readline()
        assert line, f"the peer died with exit code {self._process.wait(WAIT_S)}"
        return json.loads(line)

    def _release(self) -> None:
        for pipe in (self._process.stdin, self._process.stdout):
            pipe.close()


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
