"""Subscribes a stock client to drive commands and records when each one arrives.

As a process: ``python -m pebble.bench.bridge_subscriber PORT TOPIC``. It writes one line once it is subscribed, and
answers every line with the commands since the last one.
"""

from __future__ import annotations

import sys
import time
from typing import Any

from paho.mqtt.client import MQTTMessage

from pebble.bench.bridge_operator import Wheels, wheels_of
from pebble.contract import DRIVE
from pebble.rig.processes import Processes
from pebble.rig.stock_client import StockClient
from pebble.rig.worker_end import answer, serve

_START_S = 15.0
_ANSWER_S = 5.0


class CommandSubscriber:
    """Runs the process; it is subscribed when this has been constructed. Raises PebbleError if it is not in time."""

    def __init__(self, processes: Processes, port: int, topic: str) -> None:
        self._worker = processes.worker("the subscriber", "pebble.bench.bridge_subscriber", port, topic)
        self._worker.answer(_START_S)

    def received(self) -> dict[Wheels, int]:
        """Maps each command since the last call to the time at which it arrived (CLOCK_MONOTONIC, ns)."""
        return {(left, right): ns for left, right, ns in self._worker.ask("", _ANSWER_S)["received"]}


def main(arguments: list[str]) -> int:
    port, topic = arguments
    received: list[tuple[int, bytes]] = []

    def receive(message: MQTTMessage) -> None:
        if not message.payload.isspace():  # else a bridge's probe
            received.append((time.monotonic_ns(), bytes(message.payload)))

    def take(_line: str) -> dict[str, Any]:
        new = received.copy()
        del received[: len(new)]
        return {"received": [[*wheels_of(payload), ns] for ns, payload in new]}

    client = StockClient(receive, [(topic, DRIVE.default_qos)], at_once=False).open(int(port))
    client.wait()
    answer({"subscribed": True})
    serve(take)
    client.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
