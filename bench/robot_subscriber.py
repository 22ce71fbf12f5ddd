"""Subscribes to everything one robot publishes at the remote broker, records when and how much, and can drive it."""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from typing import Any

from paho.mqtt.client import Client, MQTTv5
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.subscribeoptions import SubscribeOptions

from pebble.bench.tcp import send_at_once
from pebble.contract import (
    AUDIO,
    AUDIO_CONTROL,
    CAMERA,
    DRIVE,
    MQTT_AUDIO,
    MQTT_VIDEO,
    ONLINE,
    STATUS,
    VIDEO_CONTROL,
    Channel,
)
from pebble.contract.packets import Codec, Picture, PictureKind, Sound
from pebble.errors import PayloadError, PebbleError

_LISTEN_S = 10.0
_AHEAD = {"x": 0.0, "z": 0.5}


class RobotSubscriber:
    """One MQTT 5 connection, since only MQTT 5 shows which live messages are published as retained.

    Times are CLOCK_MONOTONIC, in ns; None: not yet.
    """

    def __init__(self, port: int, base: str) -> None:
        self._base = base
        self._subscribed = threading.Event()
        self.first_heartbeat_ns: int | None = None
        self.ready_ns: int | None = None  # every service is ready
        self.retained: set[str] = set()  # the topics below the base with a retained message
        self.arrived: Counter[str] = Counter()  # pictures and sound packets, by encoding: "json", "h264", "pcm", "opus"
        self._client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTv5)
        self._client.on_socket_open = send_at_once
        self._client.on_connect = self._subscribe
        self._client.on_subscribe = self._listen
        self._client.on_message = self._on_message
        self._client.connect("127.0.0.1", port)
        self._client.loop_start()

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()

    def wait_until_subscribed(self) -> None:
        """Raises PebbleError if the broker does not acknowledge the subscription."""
        if not self._subscribed.wait(_LISTEN_S):
            raise PebbleError(f"the remote broker acknowledged no subscription within {_LISTEN_S:.0f} s")

    def ask_for(self, video: str, audio: str) -> None:
        """Allows pictures and sound, and requests them in these encodings."""
        for flag, request, form in ((MQTT_VIDEO, VIDEO_CONTROL, video), (MQTT_AUDIO, AUDIO_CONTROL, audio)):
            self._send(flag, True)
            self._send(request, {"enabled": True, "encoding": form})

    def drive(self, seconds: float, rate_hz: float) -> None:
        """Sends commands at a steady rate."""
        pause, due = threading.Event(), time.monotonic()
        for _ in range(round(seconds * rate_hz)):
            self._send(DRIVE, _AHEAD)
            due += 1 / rate_hz
            pause.wait(max(0.0, due - time.monotonic()))

    def _send(self, channel: Channel, body: Any) -> None:
        self._client.publish(
            channel.topic(self._base), json.dumps(body), qos=channel.default_qos, retain=channel.default_retain
        )

    def _subscribe(self, client: Client, *_: Any) -> None:
        client.subscribe(f"{self._base}/#", options=SubscribeOptions(qos=1, retainAsPublished=True))

    def _listen(self, *_: Any) -> None:
        self._subscribed.set()

    def _on_message(self, _client: Client, _data: Any, message: Any) -> None:
        now, topic = time.monotonic_ns(), message.topic.removeprefix(f"{self._base}/")
        if message.retain:
            (self.retained.add if message.payload else self.retained.discard)(message.topic)
        if topic in (CAMERA.suffix, AUDIO.suffix):
            self.arrived[encoding_of(bytes(message.payload))] += 1
        elif (
            topic == ONLINE.suffix
            and self.first_heartbeat_ns is None
            and json.loads(message.payload).get("online", True)
        ):
            self.first_heartbeat_ns = now
        elif topic == STATUS.suffix and self.ready_ns is None and _all_ready(message.payload):
            self.ready_ns = now


def encoding_of(raw: bytes) -> str:
    """The encoding of a picture or a sound packet; ``json`` if it has no binary header."""
    try:
        return "h264" if Picture.unpack(raw).kind == PictureKind.H264 else "pbvd"
    except PayloadError:
        pass
    try:
        return "opus" if Sound.unpack(raw).codec == Codec.OPUS else "pcm"
    except PayloadError:
        return "json"


def _all_ready(status: bytes) -> bool:
    """Programs on demand are ``stopped`` until requested; before the robot runs, all are."""
    states = {service["state"] for service in json.loads(status)["value"]["services"].values()}
    return "ready" in states and states <= {"ready", "stopped"}
