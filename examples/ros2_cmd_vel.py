"""Drives a robot by the Twists of ROS 2's topic /cmd_vel: python ros2_cmd_vel.py 127.0.0.1 1883 goob

It needs `pip install cyclonedds`, which speaks ROS 2's DDS, and no ROS 2. A robot obeys each Twist for half a second;
one that somebody else drives, or that is stopped, does not move.
"""

import json
import sys
from dataclasses import dataclass

from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from pebble.contract import DRIVE
from pebble.transports import MqttSettings, create

METRES_PER_S, RADIANS_PER_S = 0.5, 2.0  # of this robot at full throttle


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Twist(IdlStruct, typename="geometry_msgs::msg::dds_::Twist_"):
    linear: Vector3
    angular: Vector3


if __name__ == "__main__":
    host, port, robot = sys.argv[1:]
    node = DomainParticipant()  # of $ROS_DOMAIN_ID 0, the default
    twists = DataReader(node, Topic(node, "rt/cmd_vel", Twist))  # the topic /cmd_vel of ROS 2
    with create("mqtt", "cmd-vel", MqttSettings(host=host, port=int(port))) as bus:
        for twist in twists.take_iter(timeout=duration(days=365)):
            command = {"x": -twist.angular.z / RADIANS_PER_S, "z": twist.linear.x / METRES_PER_S, "valid_ms": 500}
            bus.publish(DRIVE.topic(f"pebble/robots/{robot}"), json.dumps(command).encode())
