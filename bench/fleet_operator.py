"""The operator of a fleet, as a process: drives every robot at a steady rate and subscribes to all heartbeats.

``python -m pebble.bench.fleet_operator PORT SECONDS RATE_HZ ID…`` writes JSON lines: one when every robot is online,
then the results when it has driven for ``SECONDS``.
"""

from __future__ import annotations

import json
import os
import sys
import time
from array import array
from collections.abc import Sequence
from typing import Final

from paho.mqtt.client import MQTTMessage

from pebble.contract import DRIVE, ONLINE
from pebble.contract.identity import Identity
from pebble.rig.stock_client import MANY, StockClient
from pebble.rig.worker_end import answer, serve_on_thread

#: Wheel speeds, left and right, in sequence: no robot gets the same command twice within eight commands.
STEPS: Final = ((1, 1), (-1, -1), (1, 0), (-1, 0), (1, -1), (0, 1), (-1, 1), (0, -1))

_ONLINE_S = 60.0
_POLL_S = 0.05


class FleetOperator(StockClient):
    """One MQTT connection. Commands are spread evenly over time, robot after robot."""

    def __init__(self, port: int, ids: Sequence[str]) -> None:
        bases = [Identity("pebble", "robots", name).base for name in ids]
        self._drives = [DRIVE.topic(base) for base in bases]
        self._index = {ONLINE.topic(base): number for number, base in enumerate(bases)}
        self.heartbeats = [array("q") for _ in ids]  # CLOCK_MONOTONIC, ns
        self.late = 0  # commands that were not sent in time
        super().__init__(self._on_message, [(topic, 0) for topic in self._index], in_flight=MANY)
        self.open(port)

    def wait_until_online(self) -> int:
        """Waits until all robots are online, or for a timeout; returns how many are."""
        end = time.monotonic() + _ONLINE_S
        while not all(self.heartbeats) and time.monotonic() < end:
            time.sleep(_POLL_S)
        return sum(map(bool, self.heartbeats))

    def drive(self, seconds: float, rate_hz: float) -> list[list[int]]:
        """Drives; returns when (CLOCK_MONOTONIC, ns) each robot's commands were published; n is STEPS[n % 8]."""
        sent: list[list[int]] = [[] for _ in self._drives]
        gap = 1 / rate_hz / len(self._drives)
        bodies = [json.dumps({"x": (left - right) / 2, "z": (left + right) / 2}) for left, right in STEPS]
        began = time.monotonic()
        for number in range(round(seconds * rate_hz) * len(self._drives)):
            step, robot = divmod(number, len(self._drives))
            left = began + number * gap - time.monotonic()
            if left > 0:
                time.sleep(left)
            elif left < -1 / rate_hz:
                self.late += 1
            sent[robot].append(time.monotonic_ns())
            self.paho.publish(self._drives[robot], bodies[step % len(STEPS)], qos=DRIVE.default_qos)
        return sent

    def _on_message(self, message: MQTTMessage) -> None:
        if not message.retain and b"true" in message.payload:
            self.heartbeats[self._index[message.topic]].append(time.monotonic_ns())


def main(arguments: list[str]) -> int:
    port, seconds, rate_hz, *ids = arguments
    serve_on_thread(lambda _line: None, lambda: os._exit(0))
    operator = FleetOperator(int(port), ids)
    answer({"online": operator.wait_until_online()})
    began, cpu = time.monotonic_ns(), time.process_time()
    sent = operator.drive(float(seconds), float(rate_hz))
    ended, cpu = time.monotonic_ns(), time.process_time() - cpu
    heartbeats = [[heartbeat for heartbeat in robot if began <= heartbeat <= ended] for robot in operator.heartbeats]
    answer(
        {"began": began, "ended": ended, "cpu_s": cpu, "late": operator.late, "sent": sent, "heartbeats": heartbeats}
    )
    operator.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
