"""Tries whether an account may publish a robot's messages at a broker, as that robot would."""

from __future__ import annotations

import threading
import time
from contextlib import closing

from pebble.contract import BRIDGE_PROBE
from pebble.doctor import Finding, fail, ok, warn
from pebble.forwarding.probes import new_probe
from pebble.transports import Message, MqttSettings, QoS, State
from pebble.transports.mqtt.transport import MqttTransport

_OPEN_S = 5.0
_ANSWER_S = 2.0
_POLL_S = 0.05


def publishing(what: str, settings: MqttSettings, base: str) -> Finding:
    """Publish a probe, which no program takes for anything else, below ``base``, and see whether it comes back."""
    topic, came_back = BRIDGE_PROBE.topic(base), threading.Event()
    payload = new_probe(time.time_ns() // 1_000_000)
    client = MqttTransport("doctor", settings)

    def note(message: Message) -> None:
        if message.payload == payload:
            came_back.set()

    with closing(client):
        client.open(_OPEN_S)
        if client.state is not State.CONNECTED:
            return warn(what, f"cannot be published to: {client.problem}")
        client.subscribe(topic, note)
        client.publish(topic, payload, qos=QoS.DELIVERED)
        deadline = time.monotonic() + _ANSWER_S
        while not came_back.wait(_POLL_S) and time.monotonic() < deadline:
            if topic in client.not_taken:
                return _refused(what, topic, client.not_taken[topic][0])
            if client.state is not State.CONNECTED or client.counters["connected"] > 1:
                return _refused(what, topic, "the broker hangs up on it")
    if came_back.is_set() or settings.protocol == "5":  # which says what it refuses
        return ok(what, "accepts what this account publishes")
    return _refused(what, topic, "it does not come back (or may this account not read it?)")


def _refused(what: str, topic: str, why: str) -> Finding:
    fix = f"allow it to write and read {topic.rpartition('/')[0]}/# on the broker"
    return fail(what, f"this account may not publish to {topic}: {why}", fix)
