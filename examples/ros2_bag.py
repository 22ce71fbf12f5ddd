"""Writes the odometry of robots as a ROS 2 bag: python ros2_bag.py RECORDING.mcap BAG.mcap

It needs `pip install mcap-ros2-support`, and no ROS 2.
"""

import json
import sys
from pathlib import Path

from mcap.reader import make_reader
from mcap_ros2.writer import Writer

POSE = "float64 x\nfloat64 y\nfloat64 theta\n"

if __name__ == "__main__":
    recording, target = map(Path, sys.argv[1:])
    with recording.open("rb") as source, target.open("wb") as file:
        bag = Writer(file)
        pose = bag.register_msgdef("geometry_msgs/msg/Pose2D", POSE)
        for _, channel, message in make_reader(source).iter_messages():
            _, _, robot, _, metric = channel.topic.split("/", 4)
            if metric == "wheel-odometry":
                at = json.loads(message.data)["value"]
                value = {"x": at["x_mm"] / 1000, "y": at["y_mm"] / 1000, "theta": at["heading_rad"]}
                bag.write_message(f"/{robot}/pose", pose, value, message.log_time, message.publish_time)
        bag.finish()
