"""TCP connections through the proxy."""

import asyncio
import socket
import threading
import time
from collections.abc import Iterator

import pytest

from pebble.bench.impair.conditions import Condition, Shape
from pebble.bench.impair.forwarder import HEADERS, SEGMENT, Stream
from pebble.bench.impair.network import ProxyNetwork
from tests.support import free_port, until


@pytest.fixture
def network() -> Iterator[ProxyNetwork]:
    with ProxyNetwork("of a test") as made:
        yield made


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as made:
        made.settimeout(10)
        yield made


def joined(network: ProxyNetwork, listener: socket.socket) -> tuple[socket.socket, socket.socket]:
    near = socket.create_connection(network.broker_address(listener.getsockname()[1]), 10)
    far, _ = listener.accept()
    far.settimeout(10)
    return near, far


def test_an_end_in_one_direction_leaves_the_other_open(network: ProxyNetwork, listener: socket.socket) -> None:
    near, far = joined(network, listener)
    with near, far:
        near.sendall(b"question")
        near.shutdown(socket.SHUT_WR)
        assert far.makefile("rb").read() == b"question"
        far.sendall(b"answer")
        far.close()
        assert near.makefile("rb").read() == b"answer"


def test_a_connection_without_a_listener_ends(network: ProxyNetwork) -> None:
    with socket.create_connection(network.broker_address(free_port()), 10) as near:
        assert until(lambda: _ended(near))


def test_a_closed_side_closes_the_other(network: ProxyNetwork, listener: socket.socket) -> None:
    near, far = joined(network, listener)
    with near:
        near.sendall(b"unread")
        far.close()
        assert until(lambda: _ended(near))


def test_what_was_sent_arrives_whole_through_loss_delay_and_rate(
    network: ProxyNetwork, listener: socket.socket
) -> None:
    near, far = joined(network, listener)
    network.apply(Condition("all", Shape(kbit=2000, loss=0.02, delay_ms=10, jitter_ms=10)))
    sent = bytes(n % 251 for n in range(100_000))
    with near, far:
        threading.Thread(target=lambda: (near.sendall(sent), near.shutdown(socket.SHUT_WR)), daemon=True).start()
        assert far.makefile("rb").read() == sent


def test_a_lost_segment_delays_the_ones_behind_it(network: ProxyNetwork, listener: socket.socket) -> None:
    near, far = joined(network, listener)
    network.apply(Condition("lost", Shape(loss=0.99)))  # retransmission would take minutes
    with near, far:
        near.sendall(b"x")
        assert until(lambda: network.traffic().dropped_up > 0)
        far.settimeout(0.1)
        with pytest.raises(TimeoutError):
            far.recv(1)


def test_a_retransmission_is_counted_and_uses_the_rate() -> None:
    direction, pieces, kbit = Stream("up"), 50, 10_000
    direction.apply(Shape(kbit=kbit, loss=0.5), 0.0)

    async def carry() -> float:
        began = time.monotonic()
        for _ in range(pieces):
            await direction.carry(SEGMENT)
        before = direction.packets
        await direction.carry(1)  # waits for all of them
        return (time.monotonic() - began) * kbit * 1000 / 8 - (before - 5) * (SEGMENT + HEADERS)

    assert asyncio.run(carry()) > 0
    assert direction.dropped > pieces / 4
    assert direction.packets == pieces + 1 + direction.dropped
    assert direction.bytes > (pieces + direction.dropped / 2) * (SEGMENT + HEADERS)


def test_connections_share_the_rate(network: ProxyNetwork, listener: socket.socket) -> None:
    pairs = [joined(network, listener) for _ in range(2)]
    network.apply(Condition("512k", Shape(kbit=512)))
    began = time.monotonic()
    for near, _ in pairs:
        threading.Thread(target=near.sendall, args=(b"x" * 16_000,), daemon=True).start()
    for near, far in pairs:
        with near, far:
            assert len(far.makefile("rb").read(16_000)) == 16_000
    assert time.monotonic() - began > 2 * 16_000 * 8 / 512_000


def _ended(near: socket.socket) -> bool:
    near.settimeout(0.05)
    try:
        return near.recv(100) == b""
    except TimeoutError:
        return False
    except OSError:
        return True
