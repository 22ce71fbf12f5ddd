"""Drives robots at a steady rate, as a process: ``python -m pebble.bench.estop_driver PORT``.

Each line on its standard input is the base topics of the robots to drive from now on, separated by spaces. Robots that
begin or end to be driven are sent a zero. It ends when its standard input closes.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from typing import Final

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

from pebble.bench.tcp import send_at_once
from pebble.contract import DRIVE

RATE_HZ: Final = 20.0  # of each robot
AHEAD: Final = json.dumps({"x": 0.0, "z": 0.5}).encode()
ZERO: Final = json.dumps({"x": 0.0, "z": 0.0}).encode()


class Driver:
    """One MQTT connection. Commands are spread evenly over time, robot after robot."""

    def __init__(self, port: int) -> None:
        self._lock = threading.Lock()
        self._bases: tuple[str, ...] = ()
        self._client = Client(CallbackAPIVersion.VERSION2)
        self._client.max_inflight_messages_set(65_535)
        self._client.on_socket_open = send_at_once
        self._client.connect("127.0.0.1", port)
        self._client.loop_start()

    def choose(self, bases: tuple[str, ...]) -> None:
        """Drive these robots, and no others."""
        with self._lock:
            for base in {*self._bases} ^ {*bases}:
                self._send(base, ZERO)
            self._bases = bases

    def run(self) -> None:
        """Drive for ever."""
        number, due = 0, time.monotonic()
        while True:
            with self._lock:
                count = len(self._bases)
                if count:
                    self._send(self._bases[number % count], AHEAD)
            number += 1
            due = max(due + 1 / RATE_HZ / max(1, count), time.monotonic() - 1 / RATE_HZ)
            time.sleep(max(0.0, due - time.monotonic()))

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()

    def _send(self, base: str, payload: bytes) -> None:
        self._client.publish(DRIVE.topic(base), payload, qos=DRIVE.default_qos)


def main(arguments: list[str]) -> int:
    driver = Driver(int(arguments[0]))
    threading.Thread(target=driver.run, name="driver", daemon=True).start()
    for line in sys.stdin:
        driver.choose(tuple(line.split()))
    driver.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
