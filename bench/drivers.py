"""Stock paho clients, of which the comparisons' operators and subscribers are made, and one that drives many robots.

``python -m pebble.bench.drivers PORT`` drives the robots whose base topics its newest line names, separated by spaces.
"""

from __future__ import annotations

import json
import socket
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from typing import Any, Final, Self

from paho.mqtt.client import Client, MQTTMessage, MQTTMessageInfo
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion

from pebble.contract import DRIVE, Channel
from pebble.errors import PebbleError
from pebble.rig.worker_end import serve

RATE_HZ: Final = 20.0  # of each robot
MANY: Final = 65_535  # messages in flight
AHEAD: Final = {"x": 0.0, "z": 0.5}
ZERO: Final = {"x": 0.0, "z": 0.0}
_ANSWER_S = 10.0


class StockClient:
    """One paho client on loopback with its own network thread, on which ``receive`` runs.

    ``subscriptions`` are topics with a QoS or with options. ``at_once`` sets TCP_NODELAY, as Pebble's own clients do.
    Without it, a client that receives as much as it sends delays a command in a hundred by 40 ms, until the broker's
    delayed ACK.
    """

    def __init__(
        self,
        receive: Callable[[MQTTMessage], None] = lambda _: None,
        subscriptions: Sequence[tuple[str, Any]] = (),
        *,
        at_once: bool = True,
        protocol: MQTTProtocolVersion = MQTTProtocolVersion.MQTTv311,
    ) -> None:
        self._ready, self._subscriptions = threading.Event(), list(subscriptions)
        self.paho = Client(CallbackAPIVersion.VERSION2, protocol=protocol)
        self.paho.on_connect = self._on_connect
        self.paho.on_subscribe = lambda *_: self._ready.set()
        self.paho.on_message = lambda _client, _data, message: receive(message)
        if at_once:
            self.paho.on_socket_open = _send_at_once

    def open(self, port: int) -> Self:
        """Connects and starts the network thread; returns before anything was subscribed."""
        self.paho.connect("127.0.0.1", port)
        self.paho.loop_start()
        return self

    def wait(self) -> None:
        """Until the broker has acknowledged the subscriptions, or the connection without any. Raises PebbleError."""
        if not self._ready.wait(_ANSWER_S):
            raise PebbleError(f"the broker acknowledged nothing within {_ANSWER_S:.0f} s")

    def subscribe(self, filter_: str, qos: int) -> None:
        """One more subscription, acknowledged by the broker when this returns. Raises PebbleError."""
        self._ready.clear()
        self.paho.subscribe(filter_, qos)
        self.wait()

    def close(self) -> None:
        self.paho.disconnect()
        self.paho.loop_stop()

    def send(self, channel: Channel, base: str, body: Any) -> MQTTMessageInfo:
        """Publishes ``body`` as JSON, with the QoS and the retain flag of the channel."""
        return self.paho.publish(channel.topic(base), json.dumps(body), channel.default_qos, channel.default_retain)

    def _on_connect(self, *_: Any) -> None:
        if self._subscriptions:
            self.paho.subscribe(self._subscriptions)
        else:
            self._ready.set()


def _send_at_once(_client: Client, _data: Any, sock: Any) -> None:
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


class Driver(StockClient):
    """Drives the chosen robots at :data:`RATE_HZ`, spread evenly. Those that begin or end to be driven get a zero."""

    def __init__(self, port: int, *bases: str) -> None:
        super().__init__()
        self._lock, self._closed = threading.Lock(), threading.Event()
        self._bases: tuple[str, ...] = ()
        self.paho.max_inflight_messages_set(MANY)
        self.open(port)
        self.choose(bases)
        threading.Thread(target=self._run, name="driver", daemon=True).start()

    def choose(self, bases: tuple[str, ...]) -> None:
        """Drive these robots, and no others."""
        with self._lock:
            for base in {*self._bases} ^ {*bases}:
                self.send(DRIVE, base, ZERO)
            self._bases = bases

    def _run(self) -> None:
        number, due = 0, time.monotonic()
        while not self._closed.wait(max(0.0, due - time.monotonic())):
            with self._lock:
                count = len(self._bases)
                if count:
                    self.send(DRIVE, self._bases[number % count], AHEAD)
            number += 1
            due = max(due + 1 / RATE_HZ / max(1, count), time.monotonic() - 1 / RATE_HZ)

    def close(self) -> None:
        self._closed.set()
        super().close()


def driving(port: int, *bases: str) -> closing[Driver]:
    """Drives these robots during the ``with`` block, whether or not they receive it."""
    return closing(Driver(port, *bases))


if __name__ == "__main__":
    with driving(int(sys.argv[1])) as only:
        serve(lambda line: only.choose(tuple(line.split())))
