"""Gives a stock paho client the TCP options of Pebble's own clients."""

from __future__ import annotations

import socket
from contextlib import suppress
from typing import Any

from paho.mqtt.client import Client

_QUICKACK = getattr(socket, "TCP_QUICKACK", None)  # Linux only


def send_at_once(_client: Client, _data: Any, sock: Any) -> None:
    """Sets TCP_NODELAY; to be used as ``on_socket_open``.

    Without it, a client that receives as much as it sends delays a command in a hundred by 40 ms, until the broker's
    delayed ACK.
    """
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def acknowledge(client: Client) -> None:
    """Sets TCP_QUICKACK. The kernel resets it whenever we send, so this is called after every received message."""
    sock: Any = client.socket()
    if _QUICKACK is not None and sock is not None:
        with suppress(OSError):  # the connection has just closed
            sock.setsockopt(socket.IPPROTO_TCP, _QUICKACK, 1)
