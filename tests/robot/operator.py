"""An operator that is a stock MQTT client plus the contract, without any code of Pebble."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import paho.mqtt.client as paho
from paho.mqtt.enums import CallbackAPIVersion

from tests.support import WAIT_S, until


@dataclass(frozen=True)
class ReceivedMessage:
    """One message as the operator received it."""

    at: float  # time.monotonic()
    topic: str
    payload: bytes
    retain: bool

    @property
    def json(self) -> Any:
        return json.loads(self.payload)


class Operator:
    """Connects to one broker, subscribes to one robot, records every message, and publishes on request.

    ``login``: a user name and its password.
    """

    def __init__(
        self,
        port: int,
        base: str,
        listens: str = "#",
        *,
        login: tuple[str, str] | None = None,
    ) -> None:
        self.base, self._listens = base, listens
        self.seen: list[ReceivedMessage] = []
        self._client = paho.Client(CallbackAPIVersion.VERSION2)
        if login is not None:
            self._client.username_pw_set(*login)
        self._client.on_connect = self._subscribe
        self._client.on_message = self._remember
        self._client.on_socket_open = _send_at_once
        self._client.reconnect_delay_set(min_delay=1, max_delay=1)
        self._client.connect("127.0.0.1", port, keepalive=5)
        self._client.loop_start()
        assert until(self._client.is_connected)

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()

    def drop(self) -> None:
        """Close the socket without DISCONNECT, as when a laptop is shut."""
        self._client.loop_stop()
        sock = self._client.socket()
        if sock is not None:
            sock.close()

    @property
    def is_connected(self) -> bool:
        return self._client.is_connected()

    def send(self, suffix: str, body: Any, *, qos: int = 1, retain: bool = False) -> paho.MQTTMessageInfo:
        """Publish ``body`` (bytes as they are, anything else as JSON) below the robot's base."""
        raw = body if isinstance(body, bytes) else json.dumps(body).encode()
        return self._client.publish(f"{self.base}/{suffix}", raw, qos=qos, retain=retain)

    def on(self, suffix: str, since: float = 0.0) -> list[ReceivedMessage]:
        """Everything seen on one topic after ``since`` (monotonic), without a bridge's probes."""
        found = [seen for seen in list(self.seen) if seen.topic == f"{self.base}/{suffix}" and seen.at >= since]
        return [seen for seen in found if not seen.payload.isspace()]

    def last(self, suffix: str) -> ReceivedMessage | None:
        seen = self.on(suffix)
        return seen[-1] if seen else None

    def newest(self, metric: str) -> dict[str, Any]:
        """Return what the robot said last; an empty dict if it has said nothing, or removed it."""
        seen = self.last(f"outgoing/{metric}")
        return {} if seen is None or not seen.payload else dict(seen.json)

    def wait_for(self, suffix: str, timeout: float = WAIT_S, since: float = 0.0) -> ReceivedMessage:
        """The first message on a topic after ``since``; fails when none comes in time."""
        assert until(lambda: self.on(suffix, since), timeout), f"nothing on {suffix} within {timeout} s"
        return self.on(suffix, since)[0]

    def _subscribe(self, client: paho.Client, *_: Any) -> None:
        client.subscribe(f"{self.base}/{self._listens}", qos=1)

    def _remember(self, _client: paho.Client, _data: Any, message: paho.MQTTMessage) -> None:
        self.seen.append(ReceivedMessage(time.monotonic(), message.topic, bytes(message.payload), bool(message.retain)))


def retained_messages(port: int, base: str, wait_s: float = 0.5) -> dict[str, bytes]:
    """The retained messages below ``base`` that a late subscriber receives, by suffix."""
    late = Operator(port, base)
    time.sleep(wait_s)  # nothing announces the last retained message
    late.close()
    return {seen.topic.removeprefix(f"{base}/"): seen.payload for seen in late.seen if seen.retain}


# -- numbered driving: each command sets the wheels to values of its own

_STEPS = 800  # wheel values 0.100 … 0.899, three decimals as on the serial line


def numbered(number: int) -> dict[str, float]:
    """The drive command number ``number`` (0 … 639,999): both wheels turn, each command differently."""
    left = 0.1 + (number % _STEPS) / 1000
    right = 0.1 + (number // _STEPS % _STEPS) / 1000
    return {"x": (left - right) / 2, "z": (left + right) / 2}


def number_of(left: float, right: float) -> int:
    """Which command set these wheels."""
    return round((left - 0.1) * 1000) + _STEPS * round((right - 0.1) * 1000)


_PERIOD_S = 0.05


class Driver:
    """Sends 20 commands a second until stopped, and remembers when each was sent; ``body`` makes one of a number."""

    def __init__(self, operator: Operator, first: int = 0, *, body: Callable[[int], dict[str, Any]] = numbered) -> None:
        self.sent_at: dict[int, float] = {}
        self._operator, self._first, self._body = operator, first, body
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        number, due = self._first, time.monotonic()
        while not self._stop.is_set():
            self.sent_at[number] = time.monotonic()
            self._operator.send("incoming/drive-values", self._body(number))
            number += 1
            due += _PERIOD_S
            self._stop.wait(max(0.0, due - time.monotonic()))


@contextmanager
def driving(operator: Operator, z: float, **more: Any) -> Iterator[Driver]:
    """Drive straight at 20 Hz, as a page does; ``more`` is the rest of each command."""
    driver = Driver(operator, body=lambda _: {"x": 0, "z": z, **more})
    try:
        yield driver
    finally:
        driver.stop()


def _send_at_once(_client: paho.Client, _data: Any, sock: socket.socket) -> None:
    """Without it a command waits for the confirmation of what this client has acknowledged: up to 40 ms."""
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
