"""What compares the packets of two robots sees a difference that was planted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import pytest

from pebble.transports import Message, MqttSettings, QoS, create
from tests.support import Broker, until
from tools.same_bytes import Recorder, differences


@dataclass(frozen=True)
class Robot:
    """What one sends; all that a mask hides differs at each run."""

    topic: str = "robot/outgoing/lamp"
    payload: str = '{{"state": "ready", "t": {run}}}'
    qos: QoS = QoS.DELIVERED
    retain: bool = True
    listens: str = "robot/incoming/#"
    keepalive_s: int = 15
    will: str = "offline"
    times: int = 1

    def run(self, port: int, run: int) -> Counter[str]:
        with Recorder(port) as seen:
            settings = MqttSettings(host="127.0.0.1", port=seen.port, keepalive_s=self.keepalive_s)
            with create("mqtt", "robot", settings, will=Message("robot/online", self.will.encode())) as transport:
                transport.subscribe(self.listens, lambda _message: None)
                for number in range(self.times):
                    payload = self.payload.format(run=100 * run + number).encode()
                    assert transport.publish(self.topic, payload, qos=self.qos, retain=self.retain)
            assert until(lambda: any("DISCONNECT" in one for one in seen.packets))
            return seen.packets


PLANTED = {
    "none": Robot(),
    "topic": Robot(topic="robot/outgoing/light"),
    "field": Robot(payload='{{"state": "ready", "t": {run}, "n": 1}}'),
    "value": Robot(payload='{{"state": "Ready", "t": {run}}}'),
    "space": Robot(payload='{{"state":"ready", "t": {run}}}'),
    "qos": Robot(qos=QoS.LATEST),
    "retain": Robot(retain=False),
    "filter": Robot(listens="robot/#"),
    "keepalive": Robot(keepalive_s=16),
    "will": Robot(will="gone"),
    "number": Robot(times=20),
}
REPORT = "robot/outgoing/media-report/camera"
REPORTS = {
    "none": '{{"last_error": "no frame for {run} s", "t": {run}}}',
    "other type": '{{"last_error": {run}, "t": {run}}}',
    "other name": '{{"error": null, "t": {run}}}',
    "other type beside it": '{{"last_error": null, "t": null}}',
    "one less": '{{"t": {run}}}',
}


@pytest.fixture(scope="module")
def broker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Broker]:
    running = Broker(tmp_path_factory.mktemp("broker"))
    yield running
    running.stop()


@pytest.mark.parametrize(
    ("usual", "planted"),
    [
        (Robot(), PLANTED),
        (
            Robot(topic=REPORT, payload='{{"last_error": null, "t": {run}}}'),
            {name: Robot(topic=REPORT, payload=payload) for name, payload in REPORTS.items()},
        ),
    ],
    ids=["messages", "reports"],
)
def test_each_planted_difference_shows(broker: Broker, usual: Robot, planted: dict[str, Robot]) -> None:
    before = usual.run(broker.port, 1), usual.run(broker.port, 2)
    found = {name: list(differences(before, one.run(broker.port, 3))) for name, one in planted.items()}
    assert [name for name, lines in found.items() if not lines] == ["none"]
