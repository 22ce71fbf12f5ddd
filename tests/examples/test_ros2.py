"""The examples for ROS 2, with packages that `make test` does not install: cyclonedds, mcap-ros2-support."""

from __future__ import annotations

import json
import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from pebble.transports import Message, MqttSettings, create
from tests.ext.recordings.playing import Line, js, write
from tests.support import ROOT, Broker, Child, until

ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}


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
            assert until(lambda: writer.write(twist) or received, 30)
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
