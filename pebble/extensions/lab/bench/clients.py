"""Operators made of stock paho clients: they drive robots, or watch a robot start and stream."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from typing import Any, Final, Self

from paho.mqtt.client import Client, MQTTMessage, MQTTMessageInfo
from paho.mqtt.enums import CallbackAPIVersion

from pebble import contract
from pebble.contract.payloads import Drive
from pebble.errors import PebbleError
from pebble.extensions.lab.rig.scripted_operator import ScriptedOperator
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.transports import Message

_THROTTLE: Final = 0.5  # of robots that `driving` drives straight ahead
_ANSWER_S = 10.0
UP_S: Final = 20.0  # for a robot to start


def drive_of(left: float, right: float) -> Drive:
    """Return the drive command for these wheel speeds."""
    return Drive(x=(left - right) / 2, z=(left + right) / 2)


class StockClient:
    """A paho client on loopback with its own network thread, on which ``receive`` runs.

    ``subscriptions`` are topics with a QoS or with options. ``at_once`` sets TCP_NODELAY, as Pebble's own clients do.
    Without it, a client that receives as much as it sends delays one command in a hundred by 40 ms, until the broker's
    delayed ACK.
    """

    def __init__(
        self,
        receive: Callable[[MQTTMessage], None] = lambda _: None,
        subscriptions: Sequence[tuple[str, Any]] = (),
        *,
        at_once: bool = True,
    ) -> None:
        self._ready, self._subscriptions = threading.Event(), list(subscriptions)
        self.paho = Client(CallbackAPIVersion.VERSION2)
        self.paho.on_connect = self._on_connect
        self.paho.on_subscribe = lambda *_: self._ready.set()
        self.paho.on_message = lambda _client, _data, message: receive(message)
        if at_once:
            self.paho.on_socket_open = _send_at_once

    def open(self, port: int) -> Self:
        """Connect and start the network thread; return before any subscription is acknowledged."""
        self.paho.connect("127.0.0.1", port)
        self.paho.loop_start()
        return self

    def wait(self) -> None:
        """Wait until the subscriptions are acknowledged, or the connection if there are none. Raises PebbleError."""
        if not self._ready.wait(_ANSWER_S):
            raise PebbleError(f"the broker acknowledged nothing within {_ANSWER_S:.0f} s")

    def subscribe(self, filter_: str, qos: int) -> None:
        """Add a subscription; return when the broker has acknowledged it. Raises PebbleError."""
        self._ready.clear()
        self.paho.subscribe(filter_, qos)
        self.wait()

    def close(self) -> None:
        self.paho.disconnect()
        self.paho.loop_stop()

    def send(self, channel: contract.Channel, base: str, body: Any) -> MQTTMessageInfo:
        """Publish ``body`` as JSON, with the QoS and the retain flag of the channel."""
        return self.paho.publish(channel.topic(base), json.dumps(body), channel.default_qos, channel.default_retain)

    def publish(self, message: Message | MQTTMessage) -> None:
        self.paho.publish(message.topic, message.payload, message.qos, message.retain)

    def driver(self, base: str, wait: Callable[[float], object] = time.sleep) -> ScriptedOperator:
        """Return an operator that, like the original page, knows nothing of its robot and drives without control."""
        return ScriptedOperator(RobotView(base), self.publish, by="bench", wait=wait)

    def request_media(self, base: str) -> None:
        """Permit and request a robot's pictures as H.264, and its sound as Opus."""
        for flag, request, encoding in (
            (contract.MQTT_VIDEO, contract.VIDEO_CONTROL, "h264"),
            (contract.MQTT_AUDIO, contract.AUDIO_CONTROL, "opus"),
        ):
            self.send(flag, base, True)
            self.send(request, base, {"enabled": True, "encoding": encoding})

    def _on_connect(self, *_: Any) -> None:
        if self._subscriptions:
            self.paho.subscribe(self._subscriptions)
        else:
            self._ready.set()


def _send_at_once(_client: Client, _data: Any, sock: Any) -> None:
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


@contextmanager
def driving(port: int, *bases: str) -> Iterator[None]:
    """Drive these robots during the ``with`` block, whether or not they receive the commands."""
    ended = threading.Event()
    with closing(StockClient().open(port)) as client:
        drivers = [client.driver(base, ended.wait) for base in bases]
        threads = [threading.Thread(target=driver.drive, kwargs={"z": _THROTTLE}, daemon=True) for driver in drivers]
        for driver, thread in zip(drivers, threads, strict=True):
            driver.command(Drive())  # begins at rest, as a person does
            thread.start()
        try:
            yield
        finally:
            ended.set()
            for thread in threads:
                thread.join()


class RobotSubscriber(StockClient):
    """A record of when and how much one robot publishes. Times are CLOCK_MONOTONIC, in ns; None: not yet."""

    def __init__(self, port: int, base: str) -> None:
        self._base = base
        self.first_heartbeat_ns: int | None = None
        self.ready_ns: int | None = None  # every service is ready
        self.arrived: Counter[str] = Counter()  # pictures and sound packets, by topic below the base
        super().__init__(self._on_message, [(f"{base}/#", 1)])
        self.open(port)

    def _on_message(self, message: MQTTMessage) -> None:
        now, topic = time.monotonic_ns(), message.topic.removeprefix(f"{self._base}/")
        if topic in (contract.CAMERA.suffix, contract.AUDIO.suffix):
            self.arrived[topic] += 1
        elif topic == contract.ONLINE.suffix and self.first_heartbeat_ns is None:
            if json.loads(message.payload).get("online", True):  # else it is the will of an earlier connection
                self.first_heartbeat_ns = now
        elif topic == contract.STATUS.suffix and all_ready(json.loads(message.payload)["value"]):
            self.ready_ns = self.ready_ns or now


def all_ready(status: Mapping[str, Any]) -> bool:
    """True if all services are ready; on-demand services are ``stopped`` until requested, which counts as ready."""
    states = {service["state"] for service in status.get("services", {}).values()}
    return "ready" in states and states <= {"ready", "stopped"}
