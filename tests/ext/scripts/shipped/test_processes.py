"""The scripts as real processes on both transports, with pictures in shared memory and samples of hall sensors."""

from __future__ import annotations

import json
import math
import signal
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import pytest

from pebble.contract import MOTOR_POWER, TOUCH_SENSORS, Channel, codec
from pebble.contract.payloads import MotorPower, TouchSensors, TouchValues
from pebble.extensions.media.frames import FrameInfo, FrameWriter
from pebble.transports import Message, QoS
from tests.ext.scripts.perception.test_tags import SIZE, picture
from tests.ext.scripts.script.station import Station
from tests.support import ROOT, WAIT_S, until


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
        while not self._ended.wait(1 / 15):
            info = FrameInfo(format="bgr24", width=SIZE[0], height=SIZE[1], captured_ns=time.monotonic_ns())
            self._writer.write((self._seen if self.visible else self._empty).ravel(), info)


@pytest.fixture(scope="module", params=["zenoh", pytest.param("mqtt", marks=pytest.mark.thorough)])
def sensors(request: pytest.FixtureRequest) -> Iterator[Sensors]:
    station = Station(request.param)
    sensors = Sensors(station)
    yield sensors
    sensors.close()
    station.close()


def end(script: Any) -> str:
    """What it has printed."""
    script.send_signal(signal.SIGTERM)
    output: str = script.communicate(timeout=WAIT_S)[0]
    return output


def test_a_follower_drives_towards_the_tag_and_stops(sensors: Sensors) -> None:
    sensors.subscribe("apriltag-data", "video-overlays")
    station = sensors.station
    station.received.clear()
    script = sensors.start("apriltag-follow", "--marker-size", "0.25")
    data = sensors.messages["apriltag-data"]
    assert until(lambda: sum(one["detected"] for one in data) > 20)
    assert data[-1]["distance_m"] == pytest.approx(math.hypot(2.0, 0.3), rel=0.02)
    assert data[-1]["angle_rad"] == pytest.approx(math.atan2(0.3, 2.0), abs=0.01)
    driven = [one for one in station.received if one.drive.moves]
    assert all(one.drive.z > 0.8 and one.drive.x > 0 for one in driven[5:]), "forward, and to the right"
    gaps = sorted(after.at - before.at for before, after in pairwise(driven[5:20]))
    assert gaps[len(gaps) // 2] > 0.05, "10 a second, or fewer on a busy machine"
    sensors.visible = False
    assert until(lambda: not data[-1]["detected"])
    assert (data[-1]["corners_norm"], data[-1]["distance_m"]) == ([], None)
    sensors.visible = True
    end(script)
    assert until(station.rests)
    assert until(lambda: not data[-1]["detected"] and sensors.messages["video-overlays"][-1]["shapes"] == [])


def test_odometry_measures_the_way_and_rests_at_a_lower_rate(sensors: Sensors) -> None:
    sensors.subscribe("wheel-odometry")
    script = sensors.start("wheel-odometry")
    published = sensors.messages["wheel-odometry"]
    assert until(lambda: len(published) > 2)
    mm = sensors.roll(2.5, 0.6)
    assert until(lambda: published[-1]["value"]["x_mm"] == pytest.approx(mm, abs=20))
    assert abs(published[-1]["value"]["heading_deg"]) < 5
    assert (published[-1]["unit"], published[-1]["source"]) == ("mm", "wheel-odometry")
    moving = [one["timestamp"] for one in published if 100 < one["value"]["x_mm"] < 500]
    assert 3 < len(moving) / (moving[-1] - moving[0]) < 26, "20 a second, not the 2 at rest"
    end(script)


def test_following_by_odometry_uses_what_two_other_scripts_publish(sensors: Sensors) -> None:
    sensors.subscribe("apriltag-data", "apriltag-locations")
    station = sensors.station
    station.received.clear()
    locations, odometry = sensors.start("apriltag-locations"), sensors.start("wheel-odometry")
    follower = sensors.start("apriltag-odom-follow")
    data = sensors.messages["apriltag-data"]
    assert until(lambda: sum(one["detected"] for one in data) > 10, 40)
    assert data[-1]["distance_m"] == pytest.approx(math.hypot(2.0, 0.3), rel=0.02)
    assert until(lambda: station.moves())
    sensors.visible = False
    assert until(lambda: not data[-1]["detected"])
    before = len(station.received)
    assert until(lambda: len(station.received) > before + 8)
    assert station.received[-1].drive.z > 0.3, "it drives on to where the tag was"
    sensors.visible = True
    found = sensors.messages["apriltag-locations"]
    assert until(lambda: len(found) > 23)
    for script in (follower, locations, odometry):
        end(script)
    assert until(station.rests)
    rate = 20 / (found[23]["timestamp"] - found[3]["timestamp"])
    assert rate <= 13, "12 a second"
    assert until(lambda: found[-1]["detections"] == [])
