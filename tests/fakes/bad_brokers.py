"""Servers at loopback addresses that each fail a client in another way, and names with several addresses."""

from __future__ import annotations

import os
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

_RESET = struct.pack("ii", 1, 0)
_GRANTED = b"\x20\2\0\0"

Behaviour = Callable[[socket.socket], None]


def mute(connection: socket.socket) -> None:
    """Read, and answer nothing."""
    while connection.recv(4096):
        pass


def _closing(connection: socket.socket) -> None:
    """Hang up at once."""


def _resetting(connection: socket.socket) -> None:
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)


def _answering(answer: bytes, then: Behaviour = mute) -> Behaviour:
    def serve(connection: socket.socket) -> None:
        connection.recv(4096)
        connection.sendall(answer)
        then(connection)

    return serve


def _late(connection: socket.socket) -> None:
    connection.recv(4096)
    time.sleep(2.5)
    connection.sendall(_GRANTED)


def _dripping(connection: socket.socket) -> None:
    """Send the first byte of a CONNACK, and neither the rest nor an end."""
    for byte in (_GRANTED * 9)[:1] + b"\xff":
        connection.sendall(bytes((byte,)))
        time.sleep(0.1)
    mute(connection)


#: None: nothing listens there.
BEHAVIOURS: dict[str, Behaviour | None] = {
    "mute": mute,
    "closing": _closing,
    "closing after CONNECT": _answering(b"", _closing),
    "resetting": _resetting,
    "refusing": None,
    "server unavailable": _answering(b"\x20\2\0\3", _closing),
    "not authorized": _answering(b"\x20\2\0\5"),
    "late CONNACK": _late,
    "half a CONNACK": _dripping,
    "no MQTT": _answering(b"HTTP/1.1 400 Bad Request\r\n\r\n", _closing),
    "no SUBACK": _answering(_GRANTED),
    "closing after CONNACK": _answering(_GRANTED, _closing),
}


@contextmanager
def serving(address: str, port: int, behaviour: Behaviour | None) -> Iterator[None]:
    """Accept connections during the block; each has a thread."""
    if behaviour is None:
        yield
        return
    with ExitStack() as opened:
        server = opened.enter_context(socket.create_server((address, port), backlog=50))

        def handle(connection: socket.socket) -> None:
            with connection, suppress(OSError):
                connection.settimeout(20)
                behaviour(connection)

        def accept() -> None:
            with suppress(OSError):
                while True:
                    threading.Thread(target=handle, args=(server.accept()[0],), daemon=True).start()

        threading.Thread(target=accept, daemon=True).start()
        opened.callback(server.shutdown, socket.SHUT_RDWR)
        yield


def resolving(names: dict[str, list[str]]) -> dict[str, str]:
    """Return the environment of a Python process in which these names have these addresses, in order."""
    text = " ".join(f"{name}={','.join(addresses)}" for name, addresses in names.items())
    path = [str(Path(__file__).parent / "hosts"), os.environ.get("PYTHONPATH", "")]
    return {**os.environ, "TEST_HOSTS": text, "PYTHONPATH": os.pathsep.join(filter(None, path))}
