"""The short examples, each as its first line calls it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from queue import SimpleQueue

from examples.transport import Datagrams
from pebble.transports import Message, MqttSettings, create
from tests.ext.recordings.playing import Line, write
from tests.support import ROOT, Broker, Child, free_port, until

GOOB = "pebble/robots/goob"
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}


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


def test_the_service_publishes_on_a_topic_of_its_own(broker: Broker, tmp_path: Path) -> None:
    config = tmp_path / "goob.json"
    config.write_text(json.dumps({"robot": {"id": "goob"}, "local_mqtt": {"host": "127.0.0.1", "port": broker.port}}))
    received = SimpleQueue[Message]()
    with create("mqtt", "operator", MqttSettings(host="127.0.0.1", port=broker.port)) as operator:
        operator.subscribe(f"{GOOB}/outgoing/uptime", received.put)
        with Child(example("service", config), env=ENVIRONMENT) as program:
            assert json.loads(received.get(timeout=30).payload)["seconds"] > 0
            program.terminate()
            assert program.wait(10) == 0


def test_the_extension_adds_a_section_a_line_and_a_check(tmp_path: Path) -> None:
    shutil.copy(ROOT / "examples" / "extension.py", tmp_path)
    raw = {"robot": {"id": "goob"}, "extensions": {"extension.py": {}}, "lamp": {"watts": 20}}
    (tmp_path / "goob.json").write_text(json.dumps(raw))

    def pebble(command: str) -> str:
        line = [sys.executable, "-m", "pebble.cli", command, "goob.json"]
        return subprocess.run(line, cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True, check=False).stdout

    assert "takes 20 W" in pebble("check")
    assert "it empties the battery in an hour" in pebble("doctor")


def test_the_transport_carries_messages_between_two_clients() -> None:
    here, received = ("239.1.2.3", free_port()), SimpleQueue[Message]()
    with Datagrams("robot", here) as robot, Datagrams("operator", here) as operator:
        operator.subscribe("pebble/+/+/outgoing/online", received.put)
        assert robot.publish(f"{GOOB}/outgoing/online", b"{}")
        message = received.get(timeout=10)
        assert (message.topic, message.payload) == (f"{GOOB}/outgoing/online", b"{}")
