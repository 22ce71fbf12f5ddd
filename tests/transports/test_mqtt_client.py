"""A client against the other end of its socket, which does what no broker does on demand; and its id."""

from __future__ import annotations

import re
import select
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from pebble.transports import MqttSettings
from pebble.transports.hosts import addresses_of
from pebble.transports.mqtt import packets
from pebble.transports.mqtt.client import Client, Opening
from pebble.transports.mqtt.client_ids import unique
from tests.kit.mqtt_bytes import packet
from tests.support import until
from tests.transports.test_mqtt_packets import Noted

RECEIVE_MAXIMUM_2 = packet(0x20, b"\0\0\3\x21\0\2")


def opening(settings: MqttSettings) -> Opening:
    return Opening("client", settings, None, None, addresses_of(settings.host, settings.port)[0])


class Pair:
    """A client, and the other end of its connection."""

    def __init__(self, protocol: str) -> None:
        with socket.create_server(("127.0.0.1", 0)) as server:
            settings = MqttSettings(host="127.0.0.1", port=server.getsockname()[1], protocol=protocol)
            self.noted = Noted()
            self.client = Client(opening(settings), self.noted, bridge=False)
            self.client.open()
            self.other, _ = server.accept()
        self.other.settimeout(5)
        self.hello = self.written()

    def written(self) -> bytes:
        """What has arrived at the other end."""
        select.select([self.other], [], [], 1)
        self.other.setblocking(False)
        parts = []
        try:
            while part := self.other.recv(1 << 20):
                parts.append(part)
        except BlockingIOError:
            pass
        return b"".join(parts)

    def sends(self, data: bytes) -> None:
        """The other end does, and the client reads it."""
        self.other.setblocking(True)
        self.other.sendall(data)
        assert until(lambda: self.client.receive() == len(data))
        self.client.read(64)

    def close(self) -> None:
        self.client.close()
        self.other.close()


@pytest.fixture
def pairs() -> Iterator[Any]:
    with ExitStack() as made:

        def make(protocol: str) -> Pair:
            pair = Pair(protocol)
            made.callback(pair.close)
            return pair

        yield make


def publish(client: Client, number: int) -> None:
    client.publish("a", b"%d" % number, 1, retain=False, expires_s=None)


def test_no_more_is_in_flight_than_the_broker_takes(pairs: Any) -> None:
    pair = pairs("5")
    pair.sends(RECEIVE_MAXIMUM_2)
    for number in range(5):
        publish(pair.client, number)
    client_sent = [
        packets.publish("a", b"%d" % n, 1, n + 1, retain=False, modern=True, expires_s=None) for n in range(5)
    ]
    assert pair.written() == b"".join(client_sent[:2])
    pair.sends(packet(0x40, b"\0\1"))
    assert pair.written() == client_sent[2]
    pair.sends(packet(0x40, b"\0\2") + packet(0x40, b"\0\3"))
    assert pair.written() == b"".join(client_sent[3:])
    pair.sends(packet(0x40, b"\0\4") + 5 * packet(0x40, b"\0\5"))  # more answers than were asked for allow no more
    for number in range(3):
        publish(pair.client, number)
    assert len(pair.written()) == 2 * len(client_sent[0])


def test_a_client_that_leaves_closes_after_the_other_side(pairs: Any) -> None:
    """Else what that sends meanwhile has the connection reset, and a proxy may lose DISCONNECT with it."""
    pair, parts = pairs("3.1.1"), list[bytes]()

    def end() -> None:
        while not b"".join(parts).endswith(packets.DISCONNECT):
            parts.append(pair.other.recv(4096))
        for _ in range(3):
            pair.other.sendall(b"\xd0\0")
            time.sleep(0.01)
        parts.append(pair.other.recv(4096))  # a reset would raise
        pair.other.close()

    pair.other.setblocking(True)
    other = threading.Thread(target=end)
    other.start()
    publish(pair.client, 1)
    pair.client.disconnect()
    assert pair.client.socket is None
    other.join()
    assert parts[-1] == b""


@pytest.mark.parametrize(
    ("name", "begins"),
    [
        ("pebble/robots/goob/remote_bridge", "pebble_robots_goob_remote_bridge-"),
        ("a.b", "a_b-2e7336-"),
        ("a_b", "a_b-"),
        ("pebble/robots/größe", "pebble_robots_gr__e-9ce5d0-"),
        ("\ud800", "_-"),
        ("", "-"),
    ],
)
def test_an_id_has_letters_digits_and_two_signs(name: str, begins: str) -> None:
    first, second = unique(name), unique(name)
    assert re.fullmatch(r"[A-Za-z0-9_-]*-[0-9a-f]{16}", first)
    assert first.startswith(begins)
    assert first[:-16] == second[:-16]
    assert first != second
