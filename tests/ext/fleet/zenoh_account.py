"""An account at a Zenoh hub elsewhere, as a process: `main(JSON)` is forked, or run as `python -m … JSON`.

It prints its state; for each line on its standard input it publishes all that it was given, and prints what it has
received. One that floods publishes on and on instead, until its end, as fast as it can.
"""

from __future__ import annotations

import itertools
import json
import sys
from pathlib import Path
from typing import Any, Literal

import msgspec
import zenoh

from pebble.transports import Message, QoS, ZenohSettings
from pebble.transports.zenoh import wire
from pebble.transports.zenoh.transport import ZenohTransport


class Plan(msgspec.Struct):
    """``will``: a topic; empty for none. ``topics`` to publish to, ``filters`` to subscribe to."""

    settings: ZenohSettings
    name: str
    topics: list[str] = []
    filters: list[str] = []
    retain: bool = False
    will: str = ""
    flood: Literal["", "messages", "hellos", "queries", "states"] = ""


def flood(session: zenoh.Session, plan: Plan) -> None:
    """What has the first priority and waits for room, as no client of ours sends it; a line once it flows."""
    first: dict[str, Any] = {"priority": zenoh.Priority.REAL_TIME, "congestion_control": zenoh.CongestionControl.BLOCK}
    publishers = [session.declare_publisher(one, **first) for one in plan.topics]
    own = dict.fromkeys(map(str, range(12_000)), 1)
    hello = wire.encode(wire.Hello(f"{plan.name}{wire.OF}1", 0, None, own))
    asked: dict[str, tuple[str, bytes]] = {
        "hellos": (wire.asked(wire.HELLO, plan.name), hello),
        "queries": (f"{wire.RETAINED}*/*/*/outgoing/**", wire.encode({"comes-never": 1})),
    }
    states = f"{wire.RETAINED}pebble/robots/fred/outgoing"
    stamp = wire.Stamp(QoS.DELIVERED, 0, f"{plan.name}{wire.OF}1").pack()
    ignore = zenoh.handlers.Callback(lambda _reply: None, indirect=False)
    for number in itertools.count():
        for one in publishers:
            one.put(b"[" * 60)
        if plan.flood in asked:
            key, payload = asked[plan.flood]
            session.get(key, ignore, payload=payload, timeout=0.5, **first)
        if plan.flood == "states":
            session.put(
                f"{states}/{number % 5000}", bytes(60 + number % 100 // 99 * 200_000), attachment=stamp, **first
            )
        if number == 500:
            sys.stdout.write("flows\n")
            sys.stdout.flush()


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
        flood(client.session, plan)
    while sys.stdin.readline():
        for topic in plan.topics:
            client.publish(topic, payload, qos=QoS.DELIVERED, retain=plan.retain)
        sys.stdout.write(json.dumps(sorted(received)) + "\n")
        sys.stdout.flush()
    return 0
