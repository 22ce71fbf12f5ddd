"""A stock client of a broker that hears drive commands, and tells when each one came by.

As a process: ``python -m pebble.bench.bridge_observer PORT TOPIC``. It says once that it listens, answers every line on
its standard input by what it has heard since the last one, and ends with its standard input.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from pathlib import Path
from typing import Any, Self

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

from pebble.bench.bridge_operator import Wheels, wheels_of
from pebble.bench.frames_process import Worker, end_workers
from pebble.contract import DRIVE

_START_S = 15.0
_ANSWER_S = 5.0


class Observer:
    """The process, from outside: from ``with`` on it listens."""

    def __init__(self, port: int, topic: str, log: Path) -> None:
        self._command = [sys.executable, "-m", "pebble.bench.bridge_observer", str(port), topic]
        self._log = log

    def __enter__(self) -> Self:
        """Raises PebbleError if it does not come up."""
        self._worker = Worker("the observer", self._command, self._log)
        try:
            self._worker.answer(_START_S)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        end_workers([self._worker])

    def heard(self) -> dict[Wheels, int]:
        """When (CLOCK_MONOTONIC, ns) each command since the last question came by."""
        self._worker.tell("")
        return {(left, right): ns for left, right, ns in self._worker.answer(_ANSWER_S)["heard"]}


def main(arguments: list[str]) -> int:
    port, topic = arguments
    heard: list[tuple[int, bytes]] = []
    subscribed = threading.Event()
    client = Client(CallbackAPIVersion.VERSION2)
    client.on_message = lambda _client, _data, message: heard.append((time.monotonic_ns(), bytes(message.payload)))
    client.on_connect = lambda connected, *_: connected.subscribe(topic, DRIVE.default_qos)
    client.on_subscribe = lambda *_: subscribed.set()
    client.connect("127.0.0.1", int(port))
    client.loop_start()
    if not subscribed.wait(_START_S):
        return 1
    _answer(heard)
    client.disconnect()
    client.loop_stop()
    return 0


def _answer(heard: list[tuple[int, bytes]]) -> None:
    _say({"listening": True})
    for _ in sys.stdin:
        new = heard.copy()
        del heard[: len(new)]
        _say({"heard": [[*wheels_of(payload), ns] for ns, payload in new]})


def _say(body: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(body) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
