"""A client of a broker that waits for each answer, so that a test sees what the broker takes and delivers."""

from __future__ import annotations

import ssl
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple, Self

import paho.mqtt.client as paho
from paho.mqtt.enums import CallbackAPIVersion

from pebble.transports.base import Message
from tests.support import WAIT_S


class BrokerError(Exception):
    """The broker ends the connection, or does not answer in time."""


class RefusedError(BrokerError):
    """The broker does not let this account in."""


class Place(NamedTuple):
    """A broker to connect to. ``ca`` None: not encrypted."""

    host: str
    port: int
    ca: Path | None


class BrokerClient:
    """One connection, open from its construction until its ``with`` block ends; without ``username`` anonymous."""

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
        """Read until ``condition``. Raises BrokerError in time, and when the broker closes the connection."""
        deadline = time.monotonic() + WAIT_S
        while not condition():
            if self.closed or time.monotonic() > deadline:
                raise BrokerError(f"the broker {'closed the connection and ' * self.closed}did not {what}")
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
