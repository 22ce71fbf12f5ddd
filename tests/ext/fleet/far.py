"""A client on another machine: `python -m tests.ext.fleet.far send|receive SETTINGS TOPIC COUNT`.

Numbers are in `z`, times of the clock that all machines of a test share. A sender prints when it has sent each, a
receiver when it has received each; it publishes heartbeats below that base, if SETTINGS have one.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from pathlib import Path
from typing import Any

from pebble.contract import ONLINE
from pebble.transports import Message, MqttSettings, QoS, State, TlsSettings, Transport, ZenohSettings, create
from tests.support import until

PERIOD_S, HEARTBEAT_S = 0.025, 0.25


def connect(settings: dict[str, Any]) -> Transport:
    if "port" in settings:
        client = create("mqtt", "far", MqttSettings(host=settings["host"], port=settings["port"]))
    else:
        tls = TlsSettings(**{key: Path(one) for key, one in settings["tls"].items() if key != "enabled"})
        at_hub = {"connect": tuple(settings["connect"]), "account": settings["account"], "tls": tls, "client": True}
        client = create(
            "zenoh", f"{settings['account']}-far", ZenohSettings(run_dir=Path(settings["run_dir"]), **at_hub)
        )
    client.open(20)
    assert until(lambda: client.state is State.CONNECTED, 20), client.problem
    return client


def send(client: Transport, topic: str, count: int) -> list[tuple[float, float]]:
    sent = []
    for number in range(count):
        z = round(0.2 + number / 100_000, 5)
        sent.append((z, time.monotonic()))
        client.publish(topic, json.dumps({"x": 0.0, "z": z}).encode(), qos=QoS.DELIVERED)
        time.sleep(PERIOD_S)
    return sent


def receive(client: Transport, topic: str, count: int, base: str) -> list[tuple[float, float]]:
    received: list[tuple[float, float]] = []
    enough = threading.Event()

    def take(message: Message) -> None:
        at = time.monotonic()
        if message.payload.strip():  # else a probe for cycles
            received.append((json.loads(message.payload)["z"], at))
            if len(received) >= count:
                enough.set()

    client.subscribe(topic, take, direct=True)
    report("up")
    while not enough.wait(HEARTBEAT_S):
        if base:
            heartbeat = json.dumps({"t": int(time.time() * 1000)}).encode()
            client.publish(ONLINE.topic(base), heartbeat, qos=QoS.DELIVERED, retain=True)
    return received


def report(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def main(what: str, settings: str, topic: str, count: str) -> None:
    given = json.loads(settings)
    client = connect(given)
    if what == "send":
        found = send(client, topic, int(count))
    else:
        found = receive(client, topic, int(count), given.get("base", ""))
    report(json.dumps(found))
    client.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
