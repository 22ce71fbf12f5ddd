"""Stand-ins for a robot's camera and wheels: what they publish, and what scripts publish about it."""

from __future__ import annotations

import json
import math
import threading
import time
from collections import defaultdict
from typing import Any

from pebble.contract import MOTOR_POWER, TOUCH_SENSORS, Channel, codec
from pebble.contract.payloads import MotorPower, TouchSensors, TouchValues
from pebble.extensions.media.frames import FrameInfo, FrameWriter
from pebble.transports import Message, QoS
from tests.ext.scripts.perception.test_tags import SIZE, picture
from tests.ext.scripts.script.station import Station
from tests.support import ROOT, WAIT_S

FPS = 15


class Sensors:
    """Pictures of a tag 13 that is 2 m ahead, while ``visible``, and all messages of the channels of ``subscribe``."""

    def __init__(self, station: Station) -> None:
        self.station = station
        self.visible = True
        self.messages: dict[str, list[dict[str, Any]]] = defaultdict(list)
        self._seen, _ = picture(13, ahead_m=2.0, right_m=0.3)
        self._empty, _ = picture(13, ahead_m=2.0, right_m=50.0)
        self._writer = FrameWriter(station.config.run_dir(), "camera", capacity=self._seen.size).open()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._write, daemon=True)
        self._thread.start()

    def subscribe(self, *topics: str) -> None:
        """Outgoing topics of the robot, by their metrics."""
        for topic in topics:
            full = f"{self.station.config.base}/outgoing/{topic}"
            self.station.transport.subscribe(full, lambda message, topic=topic: self._receive(topic, message))

    def start(self, name: str, *options: str) -> Any:
        """Start a script of Pebble's."""
        self.messages.clear()
        return self.station.start_file(ROOT / "pebble/extensions/scripts/shipped" / name / "run.py", *options)

    def roll(self, seconds: float, power: float) -> float:
        """Drive both wheels straight, 50 samples a second; returns the distance in mm."""
        mm, due = 0.0, time.monotonic()
        for sample in range(round(50 * seconds)):
            if sample % 5 == 0:
                self._publish(MOTOR_POWER, MotorPower(left=power, right=power), owner="goob")
            mm += 380 * power / 50
            self._touch(mm)
            due += 1 / 50
            time.sleep(max(0.0, due - time.monotonic()))
        self._publish(MOTOR_POWER, MotorPower(left=0.0, right=0.0), owner="goob")
        return mm

    def close(self) -> None:
        self._ended.set()
        self._thread.join(WAIT_S)
        self._writer.close()

    def _touch(self, mm: float) -> None:
        phase = mm / (math.pi * 6.1) * math.pi
        level, second = (round(512 + 297 * part) for part in (math.sin(phase), -math.cos(phase)))
        self._publish(TOUCH_SENSORS, TouchSensors(value=TouchValues(a0=level, a1=level, a2=second)))

    def _publish(self, channel: Channel, value: Any, **names: str) -> None:
        raw = codec.encode(channel, value)
        self.station.transport.publish(
            channel.topic(self.station.config.base, **names), raw, qos=QoS(channel.default_qos)
        )

    def _receive(self, topic: str, message: Message) -> None:
        self.messages[topic].append(json.loads(message.payload))

    def _write(self) -> None:
        while not self._ended.wait(1 / FPS):
            info = FrameInfo(format="bgr24", width=SIZE[0], height=SIZE[1], captured_ns=time.monotonic_ns())
            self._writer.write((self._seen if self.visible else self._empty).ravel(), info)
