"""A client that sends what the original's page sends works beside ours, on the same robot at the same time.

The stand-in follows the notes on the original's operator side: QoS 0 drive commands repeated every 250 ms without
``valid_ms``, lights at QoS 1, a retained flag and a request for video, and it reads ``outgoing`` topics.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator

import paho.mqtt.client as mqtt
import pytest

from tests.ext.page.served import Served
from tests.kit.played_robot import RecordingRobot
from tests.support import until

BASE = "pebble/robots/shared"
METRICS = (
    "touch-sensors",
    "charging-status",
    "charging-level",
    "online",
    "heartbeat",
    "capabilities",
    "status",
    "logs",
)


class OriginalPage:
    """What the server of the original's page publishes for one browser."""

    def __init__(self, port: int) -> None:
        self.heartbeats = 0
        self._client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, client_id="pebble-web")  # its fixed name
        self._client.on_message = self._receive
        self._client.connect("127.0.0.1", port)
        self._client.subscribe([(f"+/+/+/outgoing/{metric}", 0) for metric in METRICS])
        self._client.subscribe("+/infrastructure")
        self._client.loop_start()

    def motion(self, left: float, right: float) -> None:
        command = {"x": (left - right) / 2, "z": (left + right) / 2, "y": 0}
        self._client.publish(f"{BASE}/incoming/drive-values", json.dumps(command), qos=0)

    def lights(self, **colour: float) -> None:
        self._client.publish(f"{BASE}/incoming/lights-solid", json.dumps(colour), qos=1)

    def video(self, on: bool) -> None:
        self._client.publish(f"{BASE}/incoming/flags/mqtt-video", json.dumps({"value": on}), qos=1, retain=True)
        self._client.publish(f"{BASE}/incoming/front-camera", json.dumps({"enabled": on}), qos=1)

    def reboot(self) -> None:
        self._client.publish(f"{BASE}/incoming/flags/reboot", json.dumps({"value": True}), qos=1)

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()

    def _receive(self, _client: mqtt.Client, _data: object, message: mqtt.MQTTMessage) -> None:
        if message.topic == f"{BASE}/outgoing/online":
            self.heartbeats += 1


@pytest.fixture
def robot(broker) -> Iterator[RecordingRobot]:
    with RecordingRobot(broker.port, BASE) as one:
        yield one


@pytest.fixture
def original(broker) -> Iterator[OriginalPage]:
    page = OriginalPage(broker.port)
    yield page
    page.close()


def test_both_pages_drive_look_and_switch(served: Served, robot: RecordingRobot, original: OriginalPage):
    with served.page() as ours:
        assert ours.knows(BASE)
        assert ours.ready()
        assert ours.take(BASE)
        ours.drive(BASE, 1, z=0.5)
        assert until(lambda: {"x": 0.0, "z": 0.5, "y": 0.0, "valid_ms": 400} in robot.drives())
        ours.drive(BASE, 1)
        original.motion(0.4, 0.2)
        assert until(lambda: any(abs(one["x"] - 0.1) < 1e-9 and "valid_ms" not in one for one in robot.drives()))
        original.motion(0, 0)
        original.lights(b=0.1, g=0.2, r=0.3)
        original.video(True)
        original.reboot()
        wanted = {"lights-solid", "front-camera", "flags/mqtt-video", "flags/reboot"}
        assert until(lambda: {f"{BASE}/incoming/{name}" for name in wanted} <= robot.topics())
        original.video(False)
        assert until(lambda: original.heartbeats >= 4)
        assert ours.value(BASE, "web/driver", "you") is True
        assert not ours.closed
        ours.drive(BASE, 2, x=0.25)
        assert until(lambda: {"x": 0.25, "z": 0.0, "y": 0.0, "valid_ms": 400} in robot.drives()), ours.refused


def test_its_fixed_client_name_does_not_disturb_ours(served: Served, broker, robot, original):
    """Two pages of the original throw each other out for ever; ours has a name of its own at each start."""
    again = OriginalPage(broker.port)  # takes the connection of the first one over
    with served.page() as ours:
        assert ours.knows(BASE)
        assert ours.value("", "web/broker", "connected") is True
        connected = threading.Event()
        assert not connected.wait(0.5)
        assert ours.value("", "web/broker", "connected") is True
    again.close()
