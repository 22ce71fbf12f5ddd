"""A subscriber to everything that one robot publishes, which watches it start and stream."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress

from paho.mqtt.client import MQTTMessage

from pebble.bench.drivers import StockClient
from pebble.contract import AUDIO, AUDIO_CONTROL, CAMERA, MQTT_AUDIO, MQTT_VIDEO, ONLINE, STATUS, VIDEO_CONTROL
from pebble.contract.packets import Codec, Picture, PictureKind, Sound
from pebble.errors import PayloadError
from pebble.rig.robot import BASE, MEDIA, Robot, one_robot

UP_S = 20.0  # for a robot to start


class RobotSubscriber(StockClient):
    """Records when and how much a robot publishes at the remote broker: CLOCK_MONOTONIC, in ns; None: not yet."""

    def __init__(self, port: int, base: str) -> None:
        self._base = base
        self.first_heartbeat_ns: int | None = None
        self.ready_ns: int | None = None  # every service is ready
        self.arrived: Counter[str] = Counter()  # pictures and sound packets, by encoding: "json", "h264", "pcm", "opus"
        super().__init__(self._on_message, [(f"{base}/#", 1)])
        self.open(port)

    def ask_for(self, video: str, audio: str) -> None:
        """Allows pictures and sound, and requests them in these encodings."""
        for flag, request, form in ((MQTT_VIDEO, VIDEO_CONTROL, video), (MQTT_AUDIO, AUDIO_CONTROL, audio)):
            self.send(flag, self._base, True)
            self.send(request, self._base, {"enabled": True, "encoding": form})

    def _on_message(self, message: MQTTMessage) -> None:
        now, topic = time.monotonic_ns(), message.topic.removeprefix(f"{self._base}/")
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
