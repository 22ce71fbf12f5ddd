"""The network of a simulated board, real and virtual: MicroPython's semantics, and network faults."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest

from pebble.extensions.lab.simulation.micropython.clock import RealClock
from pebble.extensions.lab.simulation.micropython.modules.sockets import HostNetwork
from pebble.extensions.lab.simulation.micropython.modules.streams import POLLERR, POLLIN, POLLOUT
from tests.support import free_port, until


def joined(network: Any) -> dict[str, Any]:
    """The modules of a board that has joined its Wi-Fi."""
    modules = network.modules()
    station = modules["network"].WLAN(modules["network"].STA_IF)
    station.active(True)
    network.radio.join_s = 0.0
    station.connect("home", "secret")
    assert station.isconnected()
    return modules


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(5)
        yield server


class TestHostTcp:
    def test_a_refused_connection_is_an_error_at_the_next_read(self) -> None:
        sock = joined(HostNetwork(RealClock()))["socket"].socket()
        with closing(sock):
            with pytest.raises(OSError):
                sock.connect(("127.0.0.1", free_port()))
            assert until(lambda: sock.ready(POLLIN) & POLLERR)
            with pytest.raises(OSError):
                sock.read(1)

    def test_without_wifi_nothing_arrives_and_nothing_can_be_sent(self, listener: socket.socket) -> None:
        network = HostNetwork(RealClock())
        modules = joined(network)
        sock = modules["socket"].socket()
        with pytest.raises(OSError):
            sock.connect(listener.getsockname())
        far, _ = listener.accept()
        with closing(far), closing(sock):
            assert until(lambda: sock.ready(POLLOUT))
            network.radio.lose()
            far.sendall(b"late")
            assert (sock.read(10), sock.write(b"x"), sock.ready(POLLIN | POLLOUT)) == (None, None, 0)
            with pytest.raises(OSError):
                modules["socket"].socket().connect(listener.getsockname())
            network.radio.restore()
            assert until(lambda: sock.read(10) == b"late")
