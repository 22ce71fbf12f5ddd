"""Packets in flight: delayed, in order, or dropped."""

import math
import select
import socket
from collections.abc import Iterator

import pytest

from pebble.bench.impair.conditions import Shape
from pebble.bench.impair.network import Packets
from tests.support import until


class Line:
    """A direction between two pairs of sockets, which keep packets apart as TUN devices do."""

    def __init__(self) -> None:
        self.near, source = socket.socketpair(type=socket.SOCK_DGRAM)
        sink, self.far = socket.socketpair(type=socket.SOCK_DGRAM)
        self._ends = [self.near, source, sink, self.far]
        for end in self._ends:
            end.setblocking(False)
        self.direction = Packets(source.fileno(), sink.fileno())

    def send(self, *packets: bytes) -> None:
        for packet in packets:
            self.near.send(packet)
            self.direction.take()

    def arrived(self) -> list[bytes]:
        """Delivers all packets in flight."""
        packets: list[bytes] = []

        def deliver() -> bool:
            self.direction.deliver()
            while self.far in _readable(self.far):
                packets.append(self.far.recv(2048))
            return self.direction.due == math.inf

        assert until(deliver)
        return packets

    def close(self) -> None:
        for end in self._ends:
            end.close()


def _readable(end: socket.socket) -> list[socket.socket]:
    return select.select([end], [], [], 0)[0]


@pytest.fixture
def line() -> Iterator[Line]:
    made = Line()
    yield made
    made.close()


PACKETS = [bytes([n]) * 40 for n in range(100)]


def test_packets_keep_their_order(line: Line) -> None:
    line.direction.apply(Shape(delay_ms=10))
    line.send(*PACKETS)
    assert line.arrived() == PACKETS


def test_nothing_arrives_before_its_time(line: Line) -> None:
    line.direction.apply(Shape(delay_ms=60_000))
    line.send(b"packet")
    line.direction.deliver()
    assert line.direction.due < math.inf
    assert not _readable(line.far)


def test_a_new_condition_does_not_reorder_packets(line: Line) -> None:
    line.direction.apply(Shape(delay_ms=100))
    line.send(b"first")
    line.direction.apply(Shape())
    line.send(b"second")
    assert line.arrived() == [b"first", b"second"]


def test_a_full_queue_in_flight_drops_and_counts(line: Line) -> None:
    line.direction.apply(Shape(delay_ms=60_000))
    line.send(*PACKETS * 12)
    assert line.direction.dropped == 200
