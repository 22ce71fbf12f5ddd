"""``pebble foxglove`` in a thread, or as a process, beside a real broker, and robots on it."""

from __future__ import annotations

import asyncio
import base64
import json
import re
import select
import signal
import struct
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager, nullcontext, suppress
from typing import Any, NamedTuple

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from pebble.contract import codec
from pebble.contract.channels import Channel
from pebble.extensions.foxglove.run import Settings, serve
from pebble.transports import MqttSettings, QoS, Transport, create
from tests.commands.command_line import program
from tests.support import WAIT_S, Broker, until

SUBPROTOCOL = "foxglove.sdk.v1"
_FIRST = 100  # number of a subscription, less that of its channel
#: The SDK advertises a channel a moment before it accepts subscriptions to it.
_UNKNOWN = re.compile(r"Unknown channel ID: (\d+)")
_MESSAGE = struct.Struct("<BIQ")  # opcode, subscription, time of receipt in nanoseconds


class Received(NamedTuple):
    topic: str
    at_ns: int
    data: bytes


class Watcher:
    """One connection. A thread of its own receives."""

    def __init__(self, address: str) -> None:
        self.info: dict[str, Any] = {}
        self.channels: dict[str, dict[str, Any]] = {}  # by topic
        self.statuses: list[dict[str, Any]] = []
        self.messages: list[Received] = []
        self.closed = False
        self._subscribed: dict[int, str] = {}
        self._socket = connect(address, subprotocols=[SUBPROTOCOL], max_size=None, compression=None)  # type: ignore[list-item]
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def subscribe(self, topic: str) -> None:
        """Subscribe as soon as the channel is there."""
        assert until(lambda: topic in self.channels), f"{topic} is not among {sorted(self.channels)}"
        channel = self.channels[topic]["id"]
        self._subscribed[channel + _FIRST] = topic
        self._subscribe(channel)

    def _subscribe(self, channel: int) -> None:
        self.send({"op": "subscribe", "subscriptions": [{"id": channel + _FIRST, "channelId": channel}]})

    def unsubscribe(self, topic: str) -> None:
        number = next(one for one, name in self._subscribed.items() if name == topic)
        self.send({"op": "unsubscribe", "subscriptionIds": [number]})

    def send(self, message: dict[str, Any] | bytes) -> None:
        self._socket.send(message if isinstance(message, bytes) else json.dumps(message))

    def count(self, topic: str) -> int:
        return sum(message.topic == topic for message in list(self.messages))

    def of(self, topic: str) -> list[Any]:
        """The messages of a channel as its schema has them."""
        channel = self.channels.get(topic)
        found = [message.data for message in list(self.messages) if message.topic == topic]
        if channel is None or channel["encoding"] == "json":
            return [json.loads(data) for data in found]
        kind = parser(channel)
        return [kind.FromString(data) for data in found]

    def close(self) -> None:
        self._socket.close()
        self._thread.join(WAIT_S)

    def _run(self) -> None:
        try:
            for message in self._socket:
                self._take(message)
        except ConnectionClosed:
            pass
        self.closed = True

    def _take(self, message: str | bytes) -> None:
        if isinstance(message, bytes):
            opcode, number, at_ns = _MESSAGE.unpack_from(message)
            assert opcode == 1
            self.messages.append(Received(self._subscribed[number], at_ns, message[_MESSAGE.size :]))
            return
        content = json.loads(message)
        match content["op"]:
            case "serverInfo":
                self.info = content
            case "advertise":
                self.channels |= {channel["topic"]: channel for channel in content["channels"]}
            case "status" if (found := _UNKNOWN.fullmatch(content["message"])) and int(
                found[1]
            ) + _FIRST in self._subscribed:
                self._subscribe(int(found[1]))
            case "status":
                self.statuses.append(content)


def parser(channel: dict[str, Any]) -> Any:
    """The class that the channel's own schema describes."""
    assert (channel["encoding"], channel.get("schemaEncoding", "protobuf")) == ("protobuf", "protobuf")
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(channel["schema"])).file:
        pool.Add(file)  # refuses a file before those that it imports
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"]))


GOOB, FRED = "pebble/robots/goob", "pebble/robots/fred"


def client(broker: Broker, name: str = "robot") -> Transport:
    return create("mqtt", name, MqttSettings(host="127.0.0.1", port=broker.port)).open(WAIT_S)


class Live:
    """The process, once it is ready."""

    def __init__(self, robots: Broker | str, *options: str) -> None:
        """``robots``: all of a broker, or a config file."""
        where = (robots,) if isinstance(robots, str) else ("--url", f"mqtt://127.0.0.1:{robots.port}")
        self.process = program("foxglove", *where, "--port", "0", *options)
        assert self.process.stdout is not None
        assert select.select([self.process.stdout], [], [], 30)[0], "nothing was printed"
        self.line = self.process.stdout.readline()
        found = re.search(r"ws://\S+", self.line)
        assert found is not None, self.line
        self.address = found[0]

    def end(self, by: signal.Signals = signal.SIGINT) -> tuple[int, str]:
        """Exit code, and what it printed at last."""
        self.process.send_signal(by)
        _, errors = self.process.communicate(timeout=WAIT_S)
        return self.process.returncode, errors


class Inside:
    """The same in a thread of this process."""

    def __init__(self, broker: Broker) -> None:
        where = MqttSettings(host="127.0.0.1", port=broker.port)
        self._settings = Settings(where, f"mqtt://127.0.0.1:{broker.port}", "+/+/+", "127.0.0.1", 0)
        self._ready: Future[str] = Future()
        self._loop, self._ending = asyncio.new_event_loop(), asyncio.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        self.address = self._ready.result(WAIT_S)

    def end(self) -> None:
        with suppress(RuntimeError):  # it has ended already
            self._loop.call_soon_threadsafe(self._ending.set)
        self._thread.join(WAIT_S)
        assert not self._thread.is_alive()

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(serve(self._settings, self._ready.set_result, nullcontext(self._ending)))


@contextmanager
def live(broker: Broker) -> Iterator[Inside]:
    one = Inside(broker)
    try:
        yield one
    finally:
        one.end()


def publish(robot: Transport, base: str, channel: Channel, value: Any) -> None:
    robot.publish(channel.topic(base), codec.encode(channel, value), qos=QoS.DELIVERED, retain=channel.default_retain)


def online(robot: Transport, base: str, count: int = 1) -> None:
    robot.publish(f"{base}/outgoing/online", json.dumps({"t": count}).encode(), qos=QoS.DELIVERED, retain=True)
