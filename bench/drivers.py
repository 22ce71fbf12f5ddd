"""Operators who drive many robots over one MQTT connection. Commands are spread evenly over time, robot after robot.

As processes: ``python -m pebble.bench.drivers PORT`` drives the robots whose base topics its newest line names,
separated by spaces. ``python -m pebble.bench.drivers PORT SECONDS RATE_HZ ID…`` drives a fleet: it writes a JSON line
when every robot is online, and the results when it has driven for ``SECONDS``.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from array import array
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from typing import Final

from paho.mqtt.client import MQTTMessage

from pebble.contract import DRIVE, ONLINE
from pebble.contract.identity import Identity
from pebble.rig.stock_client import MANY, StockClient
from pebble.rig.worker_end import answer, serve, serve_on_thread

RATE_HZ: Final = 20.0  # of each robot
AHEAD: Final = json.dumps({"x": 0.0, "z": 0.5}).encode()
ZERO: Final = json.dumps({"x": 0.0, "z": 0.0}).encode()
#: Wheel speeds, left and right, in sequence: no robot gets the same command twice within eight commands.
STEPS: Final = ((1, 1), (-1, -1), (1, 0), (-1, 0), (1, -1), (0, 1), (-1, 1), (0, -1))
_ONLINE_S = 60.0
_POLL_S = 0.05


class Driver(StockClient):
    """Drives the chosen robots at :data:`RATE_HZ`. Robots that begin or end to be driven are sent a zero."""

    def __init__(self, port: int) -> None:
        self._lock, self._closed = threading.Lock(), threading.Event()
        self._bases: tuple[str, ...] = ()
        super().__init__(in_flight=MANY)
        self.open(port)

    def choose(self, bases: tuple[str, ...]) -> None:
        """Drive these robots, and no others."""
        with self._lock:
            for base in {*self._bases} ^ {*bases}:
                self.send(DRIVE, base, ZERO)
            self._bases = bases

    def run(self) -> None:
        """Drive until it is closed."""
        number, due = 0, time.monotonic()
        while not self._closed.wait(max(0.0, due - time.monotonic())):
            with self._lock:
                count = len(self._bases)
                if count:
                    self.send(DRIVE, self._bases[number % count], AHEAD)
            number += 1
            due = max(due + 1 / RATE_HZ / max(1, count), time.monotonic() - 1 / RATE_HZ)

    def close(self) -> None:
        self._closed.set()
        super().close()


@contextmanager
def driving(port: int, *bases: str) -> Iterator[Driver]:
    """Drives these robots during the ``with`` block, whether or not they receive it."""
    with closing(Driver(port)) as driver:
        threading.Thread(target=driver.run, name="driver", daemon=True).start()
        driver.choose(bases)
        yield driver


def drive_fleet(port: int, seconds: float, rate_hz: float, ids: Sequence[str]) -> None:
    """Drives a whole fleet in :data:`STEPS`, and subscribes to all heartbeats. Times are CLOCK_MONOTONIC, ns."""
    bases = [Identity("pebble", "robots", name).base for name in ids]
    heartbeats = {ONLINE.topic(base): array("q") for base in bases}

    def receive(message: MQTTMessage) -> None:
        if not message.retain and b"true" in message.payload:
            heartbeats[message.topic].append(time.monotonic_ns())

    client = StockClient(receive, [(topic, 0) for topic in heartbeats], in_flight=MANY).open(port)
    end = time.monotonic() + _ONLINE_S
    while not all(heartbeats.values()) and time.monotonic() < end:
        time.sleep(_POLL_S)
    answer({"online": sum(map(bool, heartbeats.values()))})
    began = time.monotonic_ns()
    sent, late = _send_steps(client, [DRIVE.topic(base) for base in bases], seconds, rate_hz)
    ended = time.monotonic_ns()
    received = [[ns for ns in robot if began <= ns <= ended] for robot in heartbeats.values()]
    answer({"began": began, "ended": ended, "late": late, "sent": sent, "heartbeats": received})
    client.close()


def _send_steps(
    client: StockClient, topics: Sequence[str], seconds: float, rate_hz: float
) -> tuple[list[list[int]], int]:
    """When each robot's commands were published, n is STEPS[n % 8]; and how many were not sent in time."""
    sent: list[list[int]] = [[] for _ in topics]
    late, gap = 0, 1 / rate_hz / len(topics)
    bodies = [json.dumps({"x": (left - right) / 2, "z": (left + right) / 2}) for left, right in STEPS]
    began = time.monotonic()
    for number in range(round(seconds * rate_hz) * len(topics)):
        step, robot = divmod(number, len(topics))
        left = began + number * gap - time.monotonic()
        if left > 0:
            time.sleep(left)
        late += left < -1 / rate_hz
        sent[robot].append(time.monotonic_ns())
        client.paho.publish(topics[robot], bodies[step % len(STEPS)], qos=DRIVE.default_qos)
    return sent, late


def main(port: str, *fleet: str) -> None:
    if fleet:
        seconds, rate_hz, *ids = fleet
        serve_on_thread(lambda _line: None, lambda: os._exit(0))
        drive_fleet(int(port), float(seconds), float(rate_hz), ids)
    else:
        with driving(int(port)) as driver:
            serve(lambda line: driver.choose(tuple(line.split())))


if __name__ == "__main__":
    main(*sys.argv[1:])
