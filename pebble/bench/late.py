"""Who comes late: how long it takes an operator, or a service, to know all that a running robot keeps.

As a process on the robot: ``python -m pebble.bench.late CONFIG``. It says when it is there; every number on its
standard input has it open a service's transport that often, and tell how long each took.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Set
from contextlib import closing
from pathlib import Path
from typing import Any

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

import pebble.transports.mqtt  # noqa: F401  (or the first of all latecomers would wait until it is imported)
from pebble.config import load
from pebble.errors import PebbleError
from pebble.links import local_transport
from pebble.transports import Message, MqttSettings, Transport, create

_LIMIT_S = 10.0  # for one who comes late
_QUIET_S = 0.3  # without another kept copy: that was all
_LOOK_S = 0.5


def stock_operator_ms(port: int, base: str, kept: Set[str]) -> float:
    """From the call that connects a paho client to the remote broker until the last of ``kept`` has arrived.

    Raises PebbleError if something does not come.
    """
    missing = set(kept)
    client = Client(CallbackAPIVersion.VERSION2)
    client.on_connect = lambda connected, *_: connected.subscribe(f"{base}/#", qos=1)
    client.on_message = lambda _client, _data, message: missing.discard(message.topic)
    began_ns = time.monotonic_ns()
    client.connect("127.0.0.1", port)
    while missing and time.monotonic_ns() - began_ns < _LIMIT_S * 1e9:
        client.loop(_LOOK_S)
    ended_ns = time.monotonic_ns()
    client.disconnect()
    _check("a late operator", missing)
    return (ended_ns - began_ns) / 1e6


def operator_ms(port: int, base: str, kept: Set[str]) -> float:
    """The same for the client that our own tools use."""
    return joined_ms(create("mqtt", "late-operator", MqttSettings(host="127.0.0.1", port=port)), base, kept)


def joined_ms(transport: Transport, base: str, kept: Set[str]) -> float:
    """From opening ``transport``, as a service does, until the last of ``kept`` has arrived; closes it.

    Raises PebbleError if something does not come.
    """
    missing, complete, ended_ns = set(kept), threading.Event(), 0

    def hear(message: Message) -> None:
        nonlocal ended_ns
        missing.discard(message.topic)
        if not missing and not complete.is_set():
            ended_ns = time.monotonic_ns()
            complete.set()

    with closing(transport):
        began_ns = time.monotonic_ns()
        transport.open(timeout=0.0)
        transport.subscribe(f"{base}/#", hear, direct=True)
        complete.wait(_LIMIT_S)
    _check(transport.client_id, missing)
    return (ended_ns - began_ns) / 1e6


def census(transport: Transport, base: str) -> set[str]:
    """The topics below ``base`` that have a kept copy. Takes a moment: no message says that it is the last."""
    found: set[str] = set()
    heard = threading.Event()

    def hear(message: Message) -> None:
        if message.retain and message.topic not in found:
            found.add(message.topic)
            heard.set()

    with transport:
        transport.subscribe(f"{base}/#", hear, direct=True)
        while heard.wait(_QUIET_S):
            heard.clear()
    return found


def main(arguments: list[str]) -> int:
    config = load(Path(arguments[0]))
    _say({"there": True})
    for line in sys.stdin:
        kept = census(local_transport(config, "census"), config.base)
        times = [joined_ms(local_transport(config, "late-service"), config.base, kept) for _ in range(int(line))]
        _say({"kept": sorted(kept), "ms": times})
    return 0


def _check(who: str, missing: Set[str]) -> None:
    if missing:
        raise PebbleError(f"{who} was not told {', '.join(sorted(missing))} within {_LIMIT_S:.0f} s")


def _say(what: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(what) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
