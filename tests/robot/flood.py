"""Floods that a stranger at the broker may send."""

from __future__ import annotations

import secrets
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

from tests.kit.mqtt_bytes import connect, publish
from tests.robot.rig import BASE
from tests.transports.forked import Forked

_SLICE_S = 0.02
_CONNACK_BYTES = 4


@dataclass(frozen=True)
class Flood:
    """Messages to the robot: ``{n}`` in the topic counts to ``topics`` and begins anew."""

    topic: str
    payload: bytes
    per_second: int
    topics: int = 1
    retain: bool = False

    def packets(self, first: int, last: int) -> bytes:
        topics = (self.topic.format(n=number % self.topics) for number in range(first, last))
        return b"".join(publish(f"{BASE}/{topic}", self.payload, retain=self.retain) for topic in topics)

    def removals(self, sent: int) -> Iterator[bytes]:
        for number in range(min(sent, self.topics) if self.retain else 0):
            yield publish(f"{BASE}/{self.topic.format(n=number)}", b"", retain=True)


FLOODS = {
    "retained flags": Flood("incoming/flags/f{n}", b"x" * 100, 6_000, 60_000, retain=True),
    "retained topics": Flood("incoming/mcu/k/n{n}", b"x" * 20, 10_000, 100_000, retain=True),
    "actions": Flood("incoming/flags/reboot", b"true", 10_000),
    "unknown commands": Flood("incoming/unknown/n{n}", b"{}", 5_000, 100_000),
    "60 MB once a second": Flood("incoming/drive-values", bytes(60 << 20), 1),
    "a flag of 2 MB": Flood("incoming/flags/large", bytes(2 << 20), 1, retain=True),
}


@contextmanager
def flooding(name: str, port: int, seconds: float) -> Iterator[Forked]:
    """Floods from a process of its own, which removes afterwards what was retained; waits for its end."""
    process = Forked("tests.robot.flood", name, port, seconds)
    yield process
    process.wait(seconds + 60)


def send(broker: socket.socket, flood: Flood, seconds: float) -> int:
    """At its pace, as far as the broker reads so fast; returns how many messages that was."""
    began, sent = time.monotonic(), 0
    while (passed := time.monotonic() - began) < seconds:
        due = min(int(passed * flood.per_second) + 1, sent + max(1, flood.per_second // 10))
        broker.sendall(flood.packets(sent, due))
        sent = due
        time.sleep(_SLICE_S)
    return sent


def main(name: str, port: int, seconds: float) -> None:
    flood = FLOODS[name]
    with suppress(ConnectionError), socket.create_connection(("127.0.0.1", port)) as broker:
        broker.sendall(connect(None, None, client_id=f"flood-{secrets.token_hex(4)}"))
        broker.recv(_CONNACK_BYTES)
        for packet in flood.removals(send(broker, flood, seconds)):
            broker.sendall(packet)
