"""The short examples, each as its first line calls it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from pebble.transports import Message, MqttSettings, create
from tests.ext.recordings.playing import Line, write
from tests.support import ROOT, Broker, Child, until

GOOB = "pebble/robots/goob"


def example(name: str, *arguments: object) -> list[str]:
    return [sys.executable, str(ROOT / "examples" / f"{name}.py"), *map(str, arguments)]


def test_subscribe_prints_what_a_robot_publishes(broker: Broker) -> None:
    program = Child(example("subscribe", "127.0.0.1", broker.port), stdout=subprocess.PIPE, text=True)
    with program, create("mqtt", "robot", MqttSettings(host="127.0.0.1", port=broker.port)) as robot:
        level = json.dumps({"value": 7.4, "unit": "v"}).encode()
        robot.publish(f"{GOOB}/outgoing/charging-level", level, retain=True)
        assert program.stdout is not None
        assert program.stdout.readline() == "goob: 7.4 v\n"
        program.kill()


def test_drive_goes_ahead_for_a_second_and_stops(broker: Broker) -> None:
    received: list[Message] = []
    with create("mqtt", "robot", MqttSettings(host="127.0.0.1", port=broker.port)) as robot:
        robot.subscribe(f"{GOOB}/incoming/drive-values", received.append)
        subprocess.run(example("drive", "127.0.0.1", broker.port, "goob"), check=True, timeout=30)
        assert until(lambda: len(received) == 11)
    assert [json.loads(message.payload)["z"] for message in received] == [0.3] * 10 + [0]


def test_recording_counts_messages_by_topic(tmp_path: Path) -> None:
    topics = [f"{GOOB}/outgoing/online"] * 3 + [f"{GOOB}/outgoing/status"]
    write(tmp_path / "a.mcap", [Line(at, topic, b"{}") for at, topic in enumerate(topics)])
    done = subprocess.run(example("recording", tmp_path / "a.mcap"), capture_output=True, text=True, check=True)
    assert [line.split() for line in done.stdout.splitlines()] == [["3", topics[0]], ["1", topics[-1]]]
