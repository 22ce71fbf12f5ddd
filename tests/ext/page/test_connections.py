"""Who connects and sends nothing, or reads nothing, is given up; real sockets, a real server."""

from __future__ import annotations

import socket
import time

import pytest

from pebble.extensions.page import serve
from tests.ext.page.served import Served
from tests.support import Broker, until

UPGRADE = (
    b"GET /ws/control HTTP/1.1\r\nHost: x\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
)


@pytest.mark.parametrize(
    "sent", [b"", b"GET / HTTP/1.1\r\n", UPGRADE], ids=["nothing", "half a head", "half an upgrade"]
)
def test_who_sends_no_request_is_closed(broker: Broker, monkeypatch: pytest.MonkeyPatch, sent: bytes) -> None:
    monkeypatch.setattr(serve, "REQUEST_S", 0.5)
    with Served(broker.port) as served, socket.create_connection(("127.0.0.1", served.port), 5) as client:
        client.sendall(sent)
        began = time.monotonic()
        assert until(lambda: _is_closed(client), 3)
        assert time.monotonic() - began > 0.4


def test_who_reads_nothing_is_closed(broker: Broker, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serve, "UNREAD_S", 1.0)
    with Served(broker.port) as served, socket.socket() as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        client.connect(("127.0.0.1", served.port))
        client.sendall(b"GET /login HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n" * 2000)
        assert until(lambda: len(served.open) == 1)
        assert until(lambda: not served.open, 10)


def test_who_answers_no_ping_is_closed_though_it_is_sent_more_than_it_reads(
    broker: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serve, "PING_S", 0.2)
    monkeypatch.setattr(serve, "PONG_S", 0.2)
    with Served(broker.port) as served, socket.socket() as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        client.connect(("127.0.0.1", served.port))
        client.sendall(UPGRADE.replace(b"Host: x", b"Host: localhost\r\nOrigin: http://localhost") + b"\r\n")
        assert until(lambda: len(served.open) == 1)
        assert until(lambda: not served.open, 4)


def _is_closed(client: socket.socket) -> bool:
    client.settimeout(0.05)
    try:
        return client.recv(65536) == b""
    except TimeoutError:
        return False
    except ConnectionError:
        return True
