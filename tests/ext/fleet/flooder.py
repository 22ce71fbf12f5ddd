"""A client that sends as much as it can at QoS 0, until it is killed: `main(PORT, TOPIC)` is forked."""

from __future__ import annotations

import itertools
import socket

from pebble.transports.mqtt import packets

_BATCH = 100


def main(port: int, topic: str) -> None:
    """``#`` in the topic becomes a number, which is in the payload as well."""
    with socket.create_connection(("127.0.0.1", port)) as sock:
        hello = {"modern": False, "bridge": False, "keepalive_s": 0, "will": None, "username": None, "password": None}
        sock.sendall(packets.connect("flooder", **hello))  # type: ignore[arg-type]
        for first in itertools.count(0, _BATCH):
            sock.sendall(b"".join(_packet(topic, number) for number in range(first, first + _BATCH)))


def _packet(topic: str, number: int) -> bytes:
    name, payload = topic.replace("#", str(number)), b'{"stop": "%d"}' % number
    return packets.publish(name, payload, 0, 0, retain=False, modern=False, expires_s=None)
