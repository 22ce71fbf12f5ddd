"""Subscribers to everything that one robot publishes: one that watches it start and stream, and late ones.

A late subscriber, operator or service, waits for all retained messages of a running robot. As a process on the robot:
``python -m pebble.bench.subscribers CONFIG``. It writes one line when it is ready. For every number on its standard
input it opens a service's transport that often and answers with the times.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator, Set
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

from paho.mqtt.client import Client, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
from paho.mqtt.subscribeoptions import SubscribeOptions

import pebble.transports.mqtt.transport  # noqa: F401  (otherwise the first subscriber would include the import)
from pebble.bench.drivers import StockClient
from pebble.config import load
from pebble.contract import AUDIO, AUDIO_CONTROL, CAMERA, MQTT_AUDIO, MQTT_VIDEO, ONLINE, STATUS, VIDEO_CONTROL
from pebble.contract.packets import Codec, Picture, PictureKind, Sound
from pebble.errors import PayloadError, PebbleError
from pebble.rig.robot import BASE, MEDIA, Robot, one_robot
from pebble.rig.worker_end import answer, serve
from pebble.runtime.connections import local_transport
from pebble.transports import Message, MqttSettings, Transport, create

UP_S = 20.0  # for a robot to start
_LIMIT_S = 10.0  # for one late subscriber
_QUIET_S = 0.3  # without another retained message until all count as received
_POLL_S = 0.5


class RobotSubscriber(StockClient):
    """Records when and how much a robot publishes at the remote broker.

    One MQTT 5 connection, since only MQTT 5 shows which live messages are published as retained. Times are
    CLOCK_MONOTONIC, in ns; None: not yet.
    """

    def __init__(self, port: int, base: str) -> None:
        self._base = base
        self.first_heartbeat_ns: int | None = None
        self.ready_ns: int | None = None  # every service is ready
        self.retained: set[str] = set()  # the topics below the base with a retained message
        self.arrived: Counter[str] = Counter()  # pictures and sound packets, by encoding: "json", "h264", "pcm", "opus"
        everything = SubscribeOptions(qos=1, retainAsPublished=True)
        super().__init__(self._on_message, [(f"{base}/#", everything)], protocol=MQTTProtocolVersion.MQTTv5)
        self.open(port)

    def ask_for(self, video: str, audio: str) -> None:
        """Allows pictures and sound, and requests them in these encodings."""
        for flag, request, form in ((MQTT_VIDEO, VIDEO_CONTROL, video), (MQTT_AUDIO, AUDIO_CONTROL, audio)):
            self.send(flag, self._base, True)
            self.send(request, self._base, {"enabled": True, "encoding": form})

    def _on_message(self, message: MQTTMessage) -> None:
        now, topic = time.monotonic_ns(), message.topic.removeprefix(f"{self._base}/")
        if message.retain:
            (self.retained.add if message.payload else self.retained.discard)(message.topic)
        if topic in (CAMERA.suffix, AUDIO.suffix):
            self.arrived[encoding_of(bytes(message.payload))] += 1
        elif topic == ONLINE.suffix and self.first_heartbeat_ns is None:
            self.first_heartbeat_ns = now if json.loads(message.payload).get("online", True) else None
        elif topic == STATUS.suffix and self.ready_ns is None and _all_ready(message.payload):
            self.ready_ns = now


@contextmanager
def ready_robot(kind: str) -> Iterator[tuple[Robot, RobotSubscriber]]:
    """A robot with a camera and a microphone whose services are ready. Raises PebbleError with its log."""
    with one_robot(kind, services=MEDIA) as robot, closing(RobotSubscriber(robot.remote_port, BASE)) as subscriber:
        subscriber.wait()
        robot.launch()
        robot.expect(lambda: subscriber.ready_ns is not None, "not every service is ready", UP_S)
        yield robot, subscriber


def encoding_of(raw: bytes) -> str:
    """The encoding of a picture or a sound packet; ``json`` if it has no binary header."""
    with suppress(PayloadError):
        return "h264" if Picture.unpack(raw).kind == PictureKind.H264 else "pbvd"
    with suppress(PayloadError):
        return "opus" if Sound.unpack(raw).codec == Codec.OPUS else "pcm"
    return "json"


def _all_ready(status: bytes | bytearray) -> bool:
    """Programs on demand are ``stopped`` until requested; before the robot runs, all are."""
    states = {service["state"] for service in json.loads(status)["value"]["services"].values()}
    return "ready" in states and states <= {"ready", "stopped"}


# -- late ones


def stock_operator_ms(port: int, base: str, retained: Set[str]) -> float:
    """Time from connecting a paho client to the remote broker until the last of ``retained`` has arrived.

    Raises PebbleError if a topic does not arrive.
    """
    missing = set(retained)
    client = Client(CallbackAPIVersion.VERSION2)
    client.on_connect = lambda connected, *_: connected.subscribe(f"{base}/#", qos=1)
    client.on_message = lambda _client, _data, message: missing.discard(message.topic)
    began_ns = time.monotonic_ns()
    client.connect("127.0.0.1", port)
    while missing and time.monotonic_ns() - began_ns < _LIMIT_S * 1e9:
        client.loop(_POLL_S)
    ended_ns = time.monotonic_ns()
    client.disconnect()
    return _checked_ms("a late operator", missing, began_ns, ended_ns)


def operator_ms(port: int, base: str, retained: Set[str]) -> float:
    """The same for the MQTT client of Pebble's own tools."""
    return retained_ms(create("mqtt", "late-operator", MqttSettings(host="127.0.0.1", port=port)), base, retained)


def retained_ms(transport: Transport, base: str, retained: Set[str]) -> float:
    """The same from opening ``transport``, as a service does; closes it."""
    missing, complete, ended_ns = set(retained), threading.Event(), 0

    def on_message(message: Message) -> None:
        nonlocal ended_ns
        missing.discard(message.topic)
        if not missing and not complete.is_set():
            ended_ns = time.monotonic_ns()
            complete.set()

    with closing(transport):
        began_ns = time.monotonic_ns()
        transport.open(timeout=0.0)
        transport.subscribe(f"{base}/#", on_message, direct=True)
        complete.wait(_LIMIT_S)
    return _checked_ms(transport.client_id, missing, began_ns, ended_ns)


def _checked_ms(who: str, missing: Set[str], began_ns: int, ended_ns: int) -> float:
    if missing:
        raise PebbleError(f"{who} did not receive {', '.join(sorted(missing))} within {_LIMIT_S:.0f} s")
    return (ended_ns - began_ns) / 1e6


def retained_topics(transport: Transport, base: str) -> set[str]:
    """The topics below ``base`` with a retained message. Waits for a pause, since no message is marked as the last."""
    found: set[str] = set()
    received = threading.Event()

    def on_message(message: Message) -> None:
        if message.retain and message.topic not in found:
            found.add(message.topic)
            received.set()

    with transport:
        transport.subscribe(f"{base}/#", on_message, direct=True)
        while received.wait(_QUIET_S):
            received.clear()
    return found


def main(path: str) -> None:
    config = load(Path(path))

    def measure(count: str) -> dict[str, Any]:
        retained = retained_topics(local_transport(config, "retained-topics"), config.base)
        times = [retained_ms(local_transport(config, "late-service"), config.base, retained) for _ in range(int(count))]
        return {"retained": sorted(retained), "ms": times}

    answer({"ready": True})
    serve(measure)


if __name__ == "__main__":
    main(*sys.argv[1:])
