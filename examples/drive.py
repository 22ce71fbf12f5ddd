"""Drives a robot ahead for a second, from any machine: python drive.py 127.0.0.1 1883 goob

A robot obeys each command for less than a second, so a program that dies stops it. One that somebody else drives, or
that is stopped, does not move: ``outgoing/control`` and ``outgoing/estop`` say so (docs/control.md).
"""

import json
import sys
import time

from pebble.contract import DRIVE
from pebble.transports import MqttSettings, create

if __name__ == "__main__":
    host, port, robot = sys.argv[1:]
    with create("mqtt", "one-second-ahead", MqttSettings(host=host, port=int(port))) as bus:
        topic = DRIVE.topic(f"pebble/robots/{robot}")
        for _ in range(10):
            bus.publish(topic, json.dumps({"x": 0, "z": 0.3}).encode())
            time.sleep(0.1)
        bus.publish(topic, json.dumps({"x": 0, "z": 0}).encode())
