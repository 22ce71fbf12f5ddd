"""A stand-in for the original Pebble's bridge: its forwarding rules and nothing else, without any of its code."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import paho.mqtt.client as paho
from paho.mqtt.enums import CallbackAPIVersion

from tests.support import until

_REMEMBERED_S = 8.0


class OriginalBridge:
    """Forwards between two brokers as the original does.

    It forwards local ``outgoing/#`` and ``incoming/flags/#``, other local ``incoming/#`` while remote-mirror is true,
    and remote ``incoming/#`` except the audio stream: same bytes, QoS and retain flag as received. Against loops it
    remembers one payload per topic that came from the remote side, and drops one equal local message within 8 s. If
    both addresses are the same text, it forwards nothing.
    """

    def __init__(self, base: str, local: tuple[str, int], remote: tuple[str, int]) -> None:
        self._base = base
        self._remembered: dict[str, tuple[bytes, float]] = {}
        self._retained: dict[str, paho.MQTTMessage] = {}
        self._mirroring = False
        self._subscribed: set[paho.Client] = set()
        self._remote = self._client(remote, ["incoming/#"], self._on_remote)
        self._local = self._client(local, ["incoming/#", "outgoing/#"], self._on_local)
        if local != remote:
            for client in (self._remote, self._local):
                client.loop_start()
            assert until(lambda: len(self._subscribed) == 2)

    def drop_remote(self) -> None:
        """Connect to the remote broker anew, as after an outage."""
        self._subscribed.discard(self._remote)
        self._remote.reconnect()
        assert until(lambda: self._remote in self._subscribed)

    @contextmanager
    def busy_locally(self) -> Iterator[None]:
        """Receive nothing from the local broker meanwhile, as while that thread is busy: messages wait there."""
        self._local.loop_stop()
        yield
        self._local.loop_start()

    def has_received(self, suffix: str, payload: bytes) -> bool:
        """Whether this was the newest message of the remote side on that topic."""
        return self._remembered.get(f"{self._base}/{suffix}", (b"", 0.0))[0] == payload

    def close(self) -> None:
        for client in (self._local, self._remote):
            client.disconnect()
            client.loop_stop()

    def _client(self, where: tuple[str, int], suffixes: list[str], receive: Any) -> paho.Client:
        client = paho.Client(CallbackAPIVersion.VERSION2)
        client.on_message = lambda _client, _data, message: receive(message)
        client.on_connect = lambda *_: self._subscribe(client, suffixes)
        client.on_subscribe = lambda *_: self._subscribed.add(client)
        client.connect(*where)
        return client

    def _subscribe(self, client: paho.Client, suffixes: list[str]) -> None:
        client.subscribe([(f"{self._base}/{suffix}", 1) for suffix in suffixes])
        if client is self._remote:
            for message in list(self._retained.values()):
                self._pass_on(client, message)

    def _on_remote(self, message: paho.MQTTMessage) -> None:
        if message.topic == f"{self._base}/incoming/audio-stream":
            return
        self._note_mirroring(message)
        self._remembered[message.topic] = bytes(message.payload), time.monotonic()
        self._pass_on(self._local, message)

    def _on_local(self, message: paho.MQTTMessage) -> None:
        payload, at = self._remembered.get(message.topic, (b"", float("-inf")))
        if payload == message.payload and time.monotonic() - at < _REMEMBERED_S:
            del self._remembered[message.topic]
            return
        self._note_mirroring(message)
        outgoing = message.topic.startswith(f"{self._base}/outgoing/")
        if outgoing and message.retain:
            self._retained[message.topic] = message
        if outgoing or self._mirroring or message.topic.startswith(f"{self._base}/incoming/flags/"):
            self._pass_on(self._remote, message)

    def _note_mirroring(self, message: paho.MQTTMessage) -> None:
        if message.topic == f"{self._base}/incoming/flags/remote-mirror":
            self._mirroring = message.payload == b"true"

    def _pass_on(self, client: paho.Client, message: paho.MQTTMessage) -> None:
        client.publish(message.topic, message.payload, qos=message.qos, retain=message.retain)
