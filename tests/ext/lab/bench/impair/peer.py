"""Both ends of a connection: ``serve HOST`` on the broker's side, ``talk HOST PORT UDP-PORT`` on the robot's."""

import json
import socket
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

_DATAGRAM = b"x" * 100
_SO_RCVBUFFORCE = 33  # Python has no name for it


def _serve(host: str) -> None:
    tcp, udp = socket.create_server((host, 0)), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    udp.bind((host, 0))
    with suppress(PermissionError):  # datagrams are sent in namespaces only, and there it is permitted
        udp.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, 8_000_000)
    received = []
    _thread(lambda: received.extend(iter(lambda: len(udp.recv(2048)), 0)))
    _thread(lambda: [_thread(_answer, tcp.accept()[0]) for _ in iter(int, 1)])
    _write_line({"tcp": tcp.getsockname()[1], "udp": udp.getsockname()[1]})
    for _ in sys.stdin:
        _write_line({"received": len(received)})


def _answer(connection: socket.socket) -> None:
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    with connection, connection.makefile("rwb") as stream:
        for line in stream:
            way, size = line.split()
            if way == b"up":
                stream.read(int(size))
                stream.write(b"x")
            else:
                stream.write(b"x" * int(size))
            stream.flush()


def _talk(host: str, port: int, datagrams: int) -> None:
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    with socket.create_connection((host, port)) as connection, connection.makefile("rwb") as stream:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        _write_line({"result": "connected"})
        for line in sys.stdin:
            what, size = line.split()
            began = time.monotonic()
            if what == "datagrams":
                for _ in range(int(size)):
                    udp.sendto(_DATAGRAM, (host, datagrams))
                    time.sleep(0.0001)
            else:
                stream.write(line.encode() + (b"x" * int(size) if what == "up" else b""))
                stream.flush()
                stream.read(1 if what == "up" else int(size))
            _write_line({"result": time.monotonic() - began})


def _thread(what: Callable[..., object], *arguments: object) -> None:
    threading.Thread(target=what, args=arguments, daemon=True).start()


def _write_line(answer: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(answer) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    role, *rest = sys.argv[1:]
    if role == "serve":
        _serve(*rest)
    else:
        _talk(rest[0], int(rest[1]), int(rest[2]))
