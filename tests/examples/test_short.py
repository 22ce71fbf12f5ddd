"""The short examples, each as its first line calls it."""

from __future__ import annotations

import json
import math
import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from queue import SimpleQueue

import pytest

from examples.transport import Datagrams
from pebble.extensions.scripts.perception.odom_follow import Pose
from pebble.extensions.scripts.perception.tags import Place
from pebble.transports import Message, MqttSettings, create
from tests.ext.recordings.playing import Line, js, write
from tests.support import ROOT, WAIT_S, Broker, Child, free_port, until

GOOB = "pebble/robots/goob"
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}


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
            assert json.loads(received.get(timeout=WAIT_S).payload)["seconds"] > 0
            program.terminate()
            assert program.wait(WAIT_S) == 0


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
        message = received.get(timeout=WAIT_S)
        assert (message.topic, message.payload) == (f"{GOOB}/outgoing/online", b"{}")


# -- for ROS 2, with packages that `make test` does not install: cyclonedds, mcap-ros2-support


def test_a_twist_drives_the_robot(broker: Broker) -> None:
    domain, pub, topic = (pytest.importorskip(f"cyclonedds.{name}") for name in ("domain", "pub", "topic"))
    program = ROOT / "examples" / "ros2_cmd_vel.py"
    kinds = runpy.run_path(str(program))
    node = domain.DomainParticipant()
    writer = pub.DataWriter(node, topic.Topic(node, "rt/cmd_vel", kinds["Twist"]))
    twist = kinds["Twist"](kinds["Vector3"](0.25, 0.0, 0.0), kinds["Vector3"](0.0, 0.0, -1.0))
    received: list[Message] = []
    with create("mqtt", "robot", MqttSettings(host="127.0.0.1", port=broker.port)) as robot:
        robot.subscribe("pebble/robots/goob/incoming/drive-values", received.append)
        command = [sys.executable, str(program), "127.0.0.1", str(broker.port), "goob"]
        with Child(command, env=ENVIRONMENT) as child:
            assert until(lambda: writer.write(twist) or received)
            child.kill()
    assert json.loads(received[0].payload) == {"x": 0.5, "z": 0.5, "valid_ms": 500}


def test_odometry_is_a_bag_of_ros_2(tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap_ros2.reader")
    topic = "pebble/robots/goob/outgoing/wheel-odometry"
    value = {"x_mm": 250, "y_mm": 0, "heading_rad": 1.5}
    recording, bag = write(tmp_path / "a.mcap", [Line(0, topic, js(value=value))]), tmp_path / "bag.mcap"
    command = [sys.executable, str(ROOT / "examples" / "ros2_bag.py"), str(recording), str(bag)]
    subprocess.run(command, env=ENVIRONMENT, check=True)
    (message,) = reader.read_ros2_messages(bag)
    assert (message.channel.topic, message.ros_msg.x, message.ros_msg.theta) == ("/goob/pose", 0.25, 1.5)


# -- where another robot is, by the odometry of both


AT_0 = Pose(0.0, 0.0, 0.0)
AHEAD, HALF, QUARTER = Pose(0.4, 0.0, 0.0), Pose(0.2, 0.0, 0.0), math.pi / 2

#: Poses of this robot and of the other one, from the first call on, and where it is at last: metres ahead and left.
WAYS: dict[str, tuple[list[tuple[Pose, Pose]], tuple[float, float]]] = {
    "both stand": ([(AT_0, AT_0), (AT_0, AT_0)], (0.6, 0.0)),
    "this one follows": ([(AT_0, AT_0), (AT_0, AHEAD), (AHEAD, AHEAD)], (0.6, 0.0)),
    "this one turns left": ([(AT_0, AT_0), (Pose(0, 0, QUARTER), AT_0)], (0.0, -0.6)),
    "its odometry begins anew": ([(AT_0, Pose(5, 0, 0)), (AT_0, Pose(5.2, 0, 0)), (AT_0, AT_0)], (0.8, 0.0)),
    "and goes on": ([(AT_0, Pose(5, 0, 0)), (AT_0, AT_0), (AT_0, HALF)], (0.8, 0.0)),
}


@pytest.mark.parametrize("way", WAYS)
def test_it_is_known_where_it_is(way: str) -> None:
    poses, (ahead, left) = WAYS[way]
    companion = runpy.run_path(str(ROOT / "examples" / "follow-a-robot" / "run.py"))["Companion"](0.6, 0.0)
    place = [companion.place(mine, its) for mine, its in poses][-1]
    assert place == pytest.approx(Place(math.hypot(ahead, left), -math.atan2(left, ahead)))
