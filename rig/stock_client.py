"""Stock paho clients, of which the comparisons' operators and subscribers are made."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import Any, Self

from paho.mqtt.client import Client, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
from paho.mqtt.subscribeoptions import SubscribeOptions

from pebble.contract import Channel
from pebble.errors import PebbleError

_HOST = "127.0.0.1"
_ANSWER_S = 10.0
MANY = 65_535  # messages in flight
_QUICKACK = getattr(socket, "TCP_QUICKACK", None)  # Linux only

Subscriptions = Sequence[tuple[str, int]] | Sequence[tuple[str, SubscribeOptions]]


class StockClient:
    """One paho client on loopback with its own network thread, on which ``receive`` runs.

    ``at_once`` sets TCP_NODELAY, as Pebble's own clients do. Without it, a client that receives as much as it sends
    delays a command in a hundred by 40 ms, until the broker's delayed ACK.
    """

    def __init__(
        self,
        receive: Callable[[MQTTMessage], None] | None = None,
        subscriptions: Subscriptions = (),
        *,
        at_once: bool = True,
        protocol: MQTTProtocolVersion = MQTTProtocolVersion.MQTTv311,
        in_flight: int = 20,
    ) -> None:
        self._ready = threading.Event()
        self._subscriptions: Any = list(subscriptions)
        self.paho = Client(CallbackAPIVersion.VERSION2, protocol=protocol)
        self.paho.max_inflight_messages_set(in_flight)
        self.paho.on_connect = self._on_connect
        self.paho.on_subscribe = lambda *_: self._ready.set()
        if receive is not None:
            self.paho.on_message = lambda _client, _data, message: receive(message)
        if at_once:
            self.paho.on_socket_open = _send_at_once

    def open(self, port: int) -> Self:
        """Connects and starts the network thread; returns before anything was subscribed."""
        self.paho.connect(_HOST, port)
        self.paho.loop_start()
        return self

    def wait(self) -> None:
        """Until the broker has acknowledged all subscriptions, or else the connection. Raises PebbleError."""
        if not self._ready.wait(_ANSWER_S):
            what = "subscription" if self._subscriptions else "connection"
            raise PebbleError(f"the broker acknowledged no {what} within {_ANSWER_S:.0f} s")

    def subscribe(self, filter_: str, qos: int) -> None:
        """One more subscription, acknowledged by the broker when this returns. Raises PebbleError."""
        self._ready.clear()
        self._subscriptions.append((filter_, qos))
        self.paho.subscribe(filter_, qos)
        self.wait()

    def close(self) -> None:
        self.paho.disconnect()
        self.paho.loop_stop()

    def send(self, channel: Channel, base: str, body: Any) -> None:
        """Publishes ``body`` as JSON, with the QoS and the retain flag of the channel."""
        payload = body if isinstance(body, bytes) else json.dumps(body)
        self.paho.publish(channel.topic(base), payload, qos=channel.default_qos, retain=channel.default_retain)

    def acknowledge(self) -> None:
        """Sets TCP_QUICKACK. The kernel resets it whenever we send, so this is called after every received message."""
        sock: Any = self.paho.socket()
        if _QUICKACK is not None and sock is not None:
            with suppress(OSError):  # the connection has just closed
                sock.setsockopt(socket.IPPROTO_TCP, _QUICKACK, 1)

    def _on_connect(self, client: Client, *_: Any) -> None:
        if self._subscriptions:
            client.subscribe(self._subscriptions)
        else:
            self._ready.set()


def steadily(seconds: float, rate_hz: float) -> Iterator[int]:
    """Yields numbers at a steady rate; what takes longer than a period is made up for."""
    pause, due = threading.Event(), time.monotonic()
    for number in range(round(seconds * rate_hz)):
        yield number
        due += 1 / rate_hz
        pause.wait(max(0.0, due - time.monotonic()))


def _send_at_once(_client: Client, _data: Any, sock: Any) -> None:
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
