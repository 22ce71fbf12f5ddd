"""A mosquitto with the files that `pebble fleet init` writes, and a client of it that waits for each answer."""

from __future__ import annotations

import ssl
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self

import paho.mqtt.client as paho
from paho.mqtt.enums import CallbackAPIVersion

from pebble.extensions.fleet import applying
from pebble.extensions.fleet.broker_files import new_password
from pebble.extensions.fleet.certificates import CA_CERT
from pebble.extensions.fleet.folder import CONF, Fleet, Server, load
from pebble.extensions.fleet.roles import Account
from pebble.extensions.operator.places import mosquitto_path
from pebble.transports.base import Message
from tests.support import WAIT_S, Child, free_port, listening, until


class RefusedError(Exception):
    """The broker does not let this account in."""


class Place(NamedTuple):
    """A broker to connect to. ``ca`` None: not encrypted."""

    host: str
    port: int
    ca: Path | None


class BrokerClient:
    """A connection, open from its construction until its ``with`` block ends; without ``username`` anonymous."""

    def __init__(
        self,
        place: Place,
        username: str | None = None,
        password: str | None = None,
        *,
        will: Message | None = None,
    ) -> None:
        self.received: list[tuple[str, bytes]] = []
        self.closed = False  # by the broker
        self._accepted: bool | None = None
        self._waiting: set[int] = set()  # publications and subscriptions that the broker has not acknowledged
        self._client = client = paho.Client(CallbackAPIVersion.VERSION2)
        client.on_connect, client.on_disconnect = self._on_connect, self._on_disconnect
        client.on_message = lambda _client, _data, message: self.received.append((message.topic, message.payload))
        client.on_publish = client.on_subscribe = lambda _client, _data, mid, _code, _more: self._waiting.discard(mid)
        if username is not None:
            client.username_pw_set(username, password)
        if will is not None:
            client.will_set(will.topic, will.payload, will.qos)
        if place.ca is not None:
            client.tls_set_context(ssl.create_default_context(cafile=place.ca))
        client.connect(place.host, place.port)
        self.wait(lambda: self._accepted is not None, "accept a login")
        if not self._accepted:
            raise RefusedError(f"broker {place.host}:{place.port} refuses {username}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._client.disconnect()
        self.listen(0)

    def cut(self) -> None:
        """End without a word, so that the broker publishes the will."""
        self._client.socket().close()

    def subscribe(self, filters: Iterable[str], qos: int = 1) -> None:
        """Return when the broker has granted it; with QoS 0 after all that it has delivered before."""
        code, mid = self._client.subscribe([(one, qos) for one in filters])
        assert (code, mid is None) == (paho.MQTT_ERR_SUCCESS, False)
        self._waiting.add(mid)
        self.wait(lambda: mid not in self._waiting, "answer a subscription")

    def publish(self, topic: str, payload: bytes, *, retain: bool = False) -> None:
        """Send with QoS 1; :meth:`flush` waits until the broker has it."""
        self._waiting.add(self._client.publish(topic, payload, 1, retain).mid)

    def flush(self) -> None:
        self.wait(lambda: not self._waiting, "acknowledge messages")

    def wait(self, condition: Callable[[], Any], what: str) -> None:
        """Read until ``condition``. Fails in time, and when the broker closes the connection."""
        deadline = time.monotonic() + WAIT_S
        while not condition():
            if self.closed or time.monotonic() > deadline:
                raise AssertionError(f"the broker {'closed the connection and ' * self.closed}did not {what}")
            self._read(0.05)

    def listen(self, seconds: float) -> None:
        """Read for so long, or until the broker closes the connection."""
        deadline = time.monotonic() + seconds
        while not self.closed and (left := deadline - time.monotonic()) > 0:
            self._read(left)

    def _read(self, seconds: float) -> None:
        if self._client.loop(seconds) != paho.MQTT_ERR_SUCCESS:
            self.closed = True

    def _on_connect(self, _client: Any, _data: Any, _flags: Any, code: Any, _more: Any) -> None:
        self._accepted = not code.is_failure

    def _on_disconnect(self, _client: Any, _data: Any, _flags: Any, _code: Any, _more: Any) -> None:
        self.closed = True


HOST = "127.0.0.1"


class FleetBroker:
    """A folder with accounts, and its broker; ``start`` and ``stop`` it. ``passwords``: of all accounts.

    ``unencrypted``: a port without TLS, as boards need it.
    """

    def __init__(
        self,
        folder: Path,
        accounts: Mapping[str, Account],
        *,
        level: Literal["login", "named"] = "login",
        unencrypted: int | None = None,
    ) -> None:
        folder.mkdir(exist_ok=True)
        self.folder, self.port, self.unencrypted = folder, free_port(), unencrypted
        server = Server(host=HOST, port=self.port, unencrypted=unencrypted)
        self.passwords = {name: new_password() for name in accounts}
        fleet = Fleet(level=level, brokers=(server,), accounts=dict(accounts))
        applying.make(folder, fleet, self.passwords)
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def fleet(self) -> Fleet:
        return load(self.folder)

    @property
    def place(self) -> Place:
        return Place(HOST, self.port, self.folder / CA_CERT)

    def __enter__(self) -> FleetBroker:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        command = [str(mosquitto_path()), "-c", str(self.folder / CONF), "-v"]  # what clients do is in the log
        log = (self.folder / "log").open("ab")
        self._process = Child(command, stdout=log, stderr=log)
        ports = [port for port in (self.port, self.unencrypted) if port is not None]
        assert until(lambda: all(map(listening, ports))), (self.folder / "log").read_text()

    def stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait(WAIT_S)
            self._process = None

    def change(self, after: Fleet, passwords: Mapping[str, str] | None = None) -> str:
        return applying.apply(self.folder, after, passwords)

    def add(self, name: str, account: Account) -> str:
        self.passwords[name] = new_password()
        return self.change(self.fleet.with_account(name, account), {name: self.passwords[name]})

    def renew(self, name: str) -> str:
        self.passwords[name] = new_password()
        return self.change(self.fleet, {name: self.passwords[name]})

    def remove(self, name: str) -> str:
        return self.change(self.fleet.without(name))

    def login(self, name: str) -> BrokerClient:
        return BrokerClient(self.place, name, self.passwords[name])
