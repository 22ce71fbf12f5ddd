"""An account at a Zenoh hub elsewhere, as a process: `main(JSON)` is forked, or run as `python -m … JSON`.

It prints its state; for each line on its standard input it publishes all that it was given, and prints what it has
received. One that floods publishes on and on instead, until its end, as fast as it can.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import msgspec
import zenoh

from pebble.transports import Message, QoS, ZenohSettings
from pebble.transports.zenoh.transport import ZenohTransport


class Plan(msgspec.Struct):
    """``will``: a topic; empty for none. ``topics`` to publish to, ``filters`` to subscribe to."""

    settings: ZenohSettings
    name: str
    topics: list[str] = []
    filters: list[str] = []
    retain: bool = False
    will: str = ""
    flood: bool = False


def flood(session: zenoh.Session, topics: list[str]) -> None:
    """Small messages of the first priority that wait for room, which no client of ours sends."""
    first, wait = zenoh.Priority.REAL_TIME, zenoh.CongestionControl.BLOCK
    publishers = [session.declare_publisher(one, priority=first, congestion_control=wait) for one in topics]
    while True:
        for one in publishers:
            one.put(b"[" * 60)


def main(text: str) -> int:
    plan = msgspec.json.decode(text, type=Plan, dec_hook=lambda _kind, path: Path(path))
    payload = plan.name.encode()
    will = Message(plan.will, payload, QoS.DELIVERED) if plan.will else None
    received: set[str] = set()
    client = ZenohTransport(f"client-{plan.name}", plan.settings, will=will).open(10)
    for one in plan.filters:
        client.subscribe(one, lambda message: received.add(f"{message.topic} {message.retain}"))
    sys.stdout.write(f"{client.state.name}\n")
    sys.stdout.flush()
    if plan.flood:
        assert client.session is not None
        flood(client.session, plan.topics)
    while sys.stdin.readline():
        for topic in plan.topics:
            client.publish(topic, payload, qos=QoS.DELIVERED, retain=plan.retain)
        sys.stdout.write(json.dumps(sorted(received)) + "\n")
        sys.stdout.flush()
    return 0
