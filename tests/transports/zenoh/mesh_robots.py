"""Robots at a mesh of hubs, as a process: `main(endpoints, names)`. Each sends its heartbeat ten times a second."""

from __future__ import annotations

import sys
import tempfile
import threading
from pathlib import Path

from pebble.transports import Message, QoS, ZenohSettings, create

HEARTBEAT = "pebble/robots/{}/outgoing/online"
WILL = b"WILL"
PERIOD_S = 0.1


def main(endpoints: str, names: str) -> None:
    with tempfile.TemporaryDirectory(prefix="pbl") as folder:
        settings = ZenohSettings(run_dir=Path(folder), connect=tuple(endpoints.split(",")), client=True)
        robots = {}
        for name in names.split(","):
            will = Message(HEARTBEAT.format(name), WILL, QoS.DELIVERED, retain=True)
            robots[name] = create("zenoh", name, settings, will=will).open(20)
        sys.stdout.write("up\n")
        sys.stdout.flush()
        ended = threading.Event()
        threading.Thread(target=lambda: (sys.stdin.read(), ended.set()), daemon=True).start()
        number = 0
        while not ended.wait(PERIOD_S):
            number += 1
            for name, robot in robots.items():
                robot.publish(HEARTBEAT.format(name), b"%d" % number, qos=QoS.DELIVERED, retain=True)
        for robot in robots.values():
            robot.close()
