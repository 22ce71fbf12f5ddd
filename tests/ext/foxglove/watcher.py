"""A client by the published protocol (github.com/foxglove/ws-protocol, docs/spec.md), with nothing of the SDK's."""

from __future__ import annotations

import base64
import json
import re
import struct
import threading
from typing import Any, NamedTuple

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from tests.support import until

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
        assert until(lambda: topic in self.channels, 20), f"{topic} is not among {sorted(self.channels)}"
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
        self._thread.join(10)

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
