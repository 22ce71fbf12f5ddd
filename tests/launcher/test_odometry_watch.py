"""Capabilities list wheel odometry while it is being published, whichever program does it."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from pebble.launcher.odometry_watch import OdometryWatch
from pebble.runtime.parent import NOTIFY_FD, Notifier, ProvidedFeatures
from pebble.transports import QoS
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.support import until

TOPIC = "pebble/robots/rover/outgoing/wheel-odometry"
ODOMETRY = b'{"value":{"x_mm":1,"y_mm":2,"heading_rad":0},"unit":"mm","source":"s","timestamp":1}'


class Watched:
    """A watch on a clock of its own, a script that publishes, and what the launcher was notified of."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        hub = MemoryHub()
        self.now = 100.0
        self.robot, self.script = MemoryTransport("robot", hub), MemoryTransport("script", hub)
        self._read, self._write = os.pipe()
        monkeypatch.setenv(NOTIFY_FD, str(self._write))
        self.features = ProvidedFeatures(Notifier())
        self.watch = OdometryWatch(TOPIC, self.features, lambda: self.now)
        for transport in (self.robot, self.script):
            transport.open(timeout=5)
        self.watch.start(self.robot)
        os.set_blocking(self._read, False)
        os.set_blocking(self._write, False)

    def publish(self, payload: bytes = ODOMETRY) -> None:
        self.script.publish(TOPIC, payload, qos=QoS.LATEST)

    def notes(self) -> str:
        """What was written since the last call, after the watch has looked."""
        self.watch.poll()
        try:
            return os.read(self._read, 1_000_000).decode()
        except BlockingIOError:
            return ""

    def fill(self) -> int:
        """Leave no room in the launcher's pipe."""
        return os.write(self._write, b"." * 1_000_000)

    def close(self) -> None:
        self.robot.close()
        self.script.close()
        os.close(self._read)
        os.close(self._write)


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> Iterator[Watched]:
    watched = Watched(monkeypatch)
    yield watched
    watched.close()


def test_it_is_there_while_it_is_published(watched: Watched) -> None:
    assert watched.notes() == ""
    watched.publish()
    assert until(lambda: watched.notes() == "HAS wheel-odometry\n")
    watched.now += 2.9
    watched.publish()
    assert until(lambda: watched.watch.received_at == watched.now)
    watched.now += 2.9
    assert watched.notes() == ""
    watched.now += 0.2
    assert watched.notes() == "LACKS wheel-odometry\n"


def test_what_is_retained_or_no_odometry_does_not_count(watched: Watched) -> None:
    received: list[bytes] = []
    watched.script.publish(TOPIC, ODOMETRY, retain=True)
    assert until(lambda: watched.watch.received_at == watched.now), "to a subscriber that is there it is live"
    late = OdometryWatch(TOPIC, watched.features, lambda: watched.now)
    late.start(watched.robot)
    watched.robot.subscribe(TOPIC, lambda message: received.append(message.payload), direct=True)
    watched.now += 10
    before = watched.watch.received_at
    for payload in (b"{}", b"nonsense", b'{"value":1}', b""):
        watched.publish(payload)
    assert until(lambda: received[-1:] == [b""])
    assert watched.watch.received_at == before
    assert late.received_at == float("-inf")


def test_a_busy_launcher_is_notified_later(watched: Watched) -> None:
    watched.publish()
    assert until(lambda: watched.watch.received_at == watched.now)
    filled = watched.fill()
    assert watched.notes() == "." * filled
    assert watched.notes() == "HAS wheel-odometry\n"
