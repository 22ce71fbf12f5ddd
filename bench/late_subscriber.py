"""Measures how long a late subscriber, operator or service, waits for all retained messages of a running robot.

As a process on the robot: ``python -m pebble.bench.late_subscriber CONFIG``. It writes one line when it is ready. For
every number on its standard input it opens a service's transport that often and answers with the times.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Set
from contextlib import closing
from pathlib import Path

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

import pebble.transports.mqtt.transport  # noqa: F401  (otherwise the first subscriber would include the import)
from pebble.config import load
from pebble.errors import PebbleError
from pebble.rig.worker_end import answer, serve
from pebble.runtime.connections import local_transport
from pebble.transports import Message, MqttSettings, Transport, create

_LIMIT_S = 10.0  # for one late subscriber
_QUIET_S = 0.3  # without another retained message until all count as received
_POLL_S = 0.5


def stock_operator_ms(port: int, base: str, retained: Set[str]) -> float:
    """Time from connecting a paho client to the remote broker until the last of ``retained`` has arrived.

    Raises PebbleError if a topic does not arrive.
    """
    missing = set(retained)
    client = Client(CallbackAPIVersion.VERSION2)
    client.on_connect = lambda connected, *_: connected.subscribe(f"{base}/#", qos=1)
    client.on_message = lambda _client, _data, message: missing.discard(message.topic)
    began_ns = time.monotonic_ns()
    client.connect("127.0.0.1", port)
    while missing and time.monotonic_ns() - began_ns < _LIMIT_S * 1e9:
        client.loop(_POLL_S)
    ended_ns = time.monotonic_ns()
    client.disconnect()
    _check("a late operator", missing)
    return (ended_ns - began_ns) / 1e6


def operator_ms(port: int, base: str, retained: Set[str]) -> float:
    """The same for the MQTT client of Pebble's own tools."""
    return retained_ms(create("mqtt", "late-operator", MqttSettings(host="127.0.0.1", port=port)), base, retained)


def retained_ms(transport: Transport, base: str, retained: Set[str]) -> float:
    """Time from opening ``transport``, as a service does, until the last of ``retained`` has arrived; closes it.

    Raises PebbleError if a topic does not arrive.
    """
    missing, complete, ended_ns = set(retained), threading.Event(), 0

    def on_message(message: Message) -> None:
        nonlocal ended_ns
        missing.discard(message.topic)
        if not missing and not complete.is_set():
            ended_ns = time.monotonic_ns()
            complete.set()

    with closing(transport):
        began_ns = time.monotonic_ns()
        transport.open(timeout=0.0)
        transport.subscribe(f"{base}/#", on_message, direct=True)
        complete.wait(_LIMIT_S)
    _check(transport.client_id, missing)
    return (ended_ns - began_ns) / 1e6


def retained_topics(transport: Transport, base: str) -> set[str]:
    """The topics below ``base`` with a retained message. Waits for a pause, since no message is marked as the last."""
    found: set[str] = set()
    received = threading.Event()

    def on_message(message: Message) -> None:
        if message.retain and message.topic not in found:
            found.add(message.topic)
            received.set()

    with transport:
        transport.subscribe(f"{base}/#", on_message, direct=True)
        while received.wait(_QUIET_S):
            received.clear()
    return found


def main(arguments: list[str]) -> int:
    config = load(Path(arguments[0]))

    def measure(count: str) -> dict[str, object]:
        retained = retained_topics(local_transport(config, "retained-topics"), config.base)
        times = [retained_ms(local_transport(config, "late-service"), config.base, retained) for _ in range(int(count))]
        return {"retained": sorted(retained), "ms": times}

    answer({"ready": True})
    serve(measure)
    return 0


def _check(who: str, missing: Set[str]) -> None:
    if missing:
        raise PebbleError(f"{who} did not receive {', '.join(sorted(missing))} within {_LIMIT_S:.0f} s")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
