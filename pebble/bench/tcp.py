"""How a stock paho client treats TCP as our own clients do."""

from __future__ import annotations

import socket
from contextlib import suppress
from typing import Any

from paho.mqtt.client import Client

_QUICKACK = getattr(socket, "TCP_QUICKACK", None)  # Linux only


def send_at_once(_client: Client, _data: Any, sock: Any) -> None:
    """To be its ``on_socket_open``: TCP_NODELAY.

    Or who hears as much as it sends would hold a command in a hundred for 40 ms, until the broker's delayed ACK.
    """
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def acknowledge(client: Client) -> None:
    """TCP_QUICKACK. The kernel falls back to delaying whenever we send, so this follows everything that is heard."""
    sock: Any = client.socket()
    if _QUICKACK is not None and sock is not None:
        with suppress(OSError):  # the other side has just gone
            sock.setsockopt(socket.IPPROTO_TCP, _QUICKACK, 1)
