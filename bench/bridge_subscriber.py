"""Subscribes a stock client to drive commands and records when each one arrives.

As a process: ``python -m pebble.bench.bridge_subscriber PORT TOPIC``. It writes one line once it is subscribed, answers
every line on its standard input with the commands since the last one, and ends when its standard input closes.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from pathlib import Path
from typing import Any, Self

from paho.mqtt.client import Client, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion

from pebble.bench.bridge_operator import Wheels, wheels_of
from pebble.bench.worker import Worker, end_workers
from pebble.contract import DRIVE

_START_S = 15.0
_ANSWER_S = 5.0


class CommandSubscriber:
    """Runs the process; it is subscribed once ``with`` begins."""

    def __init__(self, port: int, topic: str, log: Path) -> None:
        self._command = [sys.executable, "-m", "pebble.bench.bridge_subscriber", str(port), topic]
        self._log = log

    def __enter__(self) -> Self:
        """Raises PebbleError if it does not subscribe in time."""
        self._worker = Worker("the subscriber", self._command, self._log)
        try:
            self._worker.answer(_START_S)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        end_workers([self._worker])

    def received(self) -> dict[Wheels, int]:
        """Maps each command since the last call to the time at which it arrived (CLOCK_MONOTONIC, ns)."""
        self._worker.send("")
        return {(left, right): ns for left, right, ns in self._worker.answer(_ANSWER_S)["received"]}


def main(arguments: list[str]) -> int:
    port, topic = arguments
    received: list[tuple[int, bytes]] = []
    subscribed = threading.Event()
    client = Client(CallbackAPIVersion.VERSION2)

    def receive(_client: Client, _data: object, message: MQTTMessage) -> None:
        if not message.payload.isspace():  # else a bridge's probe
            received.append((time.monotonic_ns(), bytes(message.payload)))

    client.on_message = receive
    client.on_connect = lambda connected, *_: connected.subscribe(topic, DRIVE.default_qos)
    client.on_subscribe = lambda *_: subscribed.set()
    client.connect("127.0.0.1", int(port))
    client.loop_start()
    if not subscribed.wait(_START_S):
        return 1
    _answer(received)
    client.disconnect()
    client.loop_stop()
    return 0


def _answer(received: list[tuple[int, bytes]]) -> None:
    _write_line({"subscribed": True})
    for _ in sys.stdin:
        new = received.copy()
        del received[: len(new)]
        _write_line({"received": [[*wheels_of(payload), ns] for ns, payload in new]})


def _write_line(body: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(body) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
