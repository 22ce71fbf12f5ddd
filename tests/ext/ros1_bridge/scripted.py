"""A master of ROS 1 in pure Python, and a base that is a node of ours, as programs of their own.

``python scripted.py master PORT`` and ``python scripted.py base NAME MASTER LOG``. As ``rospy_base.py`` does with real
rospy, the base logs what it hears, a line each: ``nanoseconds cmd linear angular``, ``… estop True``, ``… cancel``, and
``… up PID`` at its start. Lines in ``LOG.do`` make it do more: ``goal active``, ``goal done``, ``quiet``, ``loud``.
"""

from __future__ import annotations

import itertools
import math
import os
import struct
import sys
import threading
import time
from pathlib import Path
from socketserver import ThreadingMixIn
from typing import Any
from xmlrpc.client import ServerProxy
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

from pebble.services.ros1_bridge import messages
from pebble.services.ros1_bridge.node import Node


class Handler(SimpleXMLRPCRequestHandler):
    rpc_paths = ()


class Server(ThreadingMixIn, SimpleXMLRPCServer):
    daemon_threads = True


def server(port: int = 0) -> Server:
    return Server(("127.0.0.1", port), Handler, logRequests=False, allow_none=True)


class Master:
    """Registers topics, tells subscribers who publishes, and ends a node whose name another one takes."""

    def __init__(self, port: int) -> None:
        self.nodes: dict[str, str] = {}
        self.topics: dict[str, dict[str, list[str]]] = {"pub": {}, "sub": {}}
        self.lock = threading.RLock()
        self.server = server(port)
        for name in dir(self):
            if name[0].islower() and callable(getattr(self, name)) and name not in ("run", "tell"):
                self.server.register_function(getattr(self, name), name)

    def run(self) -> None:
        self.server.serve_forever(0.05)

    def register(self, kind: str, node: str, topic: str, uri: str) -> None:
        with self.lock:
            before, self.nodes[node] = self.nodes.get(node), uri
            names = self.topics[kind].setdefault(topic, [])
            if node not in names:
                names.append(node)
        if before not in (None, uri):
            self.tell(str(before), "shutdown", "new node registered with same name")

    def unregister(self, kind: str, node: str, topic: str, uri: str) -> list[Any]:
        with self.lock:
            if self.nodes.get(node) == uri and node in self.topics[kind].get(topic, []):
                self.topics[kind][topic].remove(node)
        return [1, "", 1]

    def tell(self, uri: str, method: str, *arguments: Any) -> None:
        def call() -> None:
            try:
                with ServerProxy(uri) as proxy:
                    getattr(proxy, method)("/master", *arguments)
            except OSError:
                return

        threading.Thread(target=call, daemon=True).start()

    def update(self, topic: str) -> None:
        with self.lock:
            uris = [self.nodes[node] for node in self.topics["pub"].get(topic, [])]
            readers = [self.nodes[node] for node in self.topics["sub"].get(topic, [])]
        for uri in readers:
            self.tell(uri, "publisherUpdate", topic, uris)

    def registerPublisher(self, node: str, topic: str, _kind: str, uri: str) -> list[Any]:  # noqa: N802
        self.register("pub", node, topic, uri)
        self.update(topic)
        return [1, "", []]

    def registerSubscriber(self, node: str, topic: str, _kind: str, uri: str) -> list[Any]:  # noqa: N802
        self.register("sub", node, topic, uri)
        return [1, "", [self.nodes[name] for name in self.topics["pub"].get(topic, [])]]

    def unregisterPublisher(self, node: str, topic: str, uri: str) -> list[Any]:  # noqa: N802
        answer = self.unregister("pub", node, topic, uri)
        self.update(topic)
        return answer

    def unregisterSubscriber(self, node: str, topic: str, uri: str) -> list[Any]:  # noqa: N802
        return self.unregister("sub", node, topic, uri)

    def lookupNode(self, _caller: str, node: str) -> list[Any]:  # noqa: N802
        uri = self.nodes.get(node)
        return [1, "", uri] if uri else [-1, "unknown node", ""]

    def getSystemState(self, _caller: str) -> list[Any]:  # noqa: N802
        return [1, "", [[[topic, names] for topic, names in self.topics[kind].items() if names]
                        for kind in ("pub", "sub")] + [[]]]  # fmt: skip


# -- messages, as bytes


def text(value: str) -> bytes:
    return struct.pack("<I", len(value.encode())) + value.encode()


def stamped(frame: str = "odom", at: float | None = None) -> bytes:
    now = time.time() if at is None else at
    return struct.pack("<III", 7, int(now), int(now % 1 * 1e9)) + text(frame)


def odometry(x: float, y: float = 0.5, z: float = 0.0, *, yaw: float = 0.0, speed: float, turn: float,
             at: float | None = None) -> bytes:  # fmt: skip
    pose = struct.pack("<7d", x, y, z, 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)) + bytes(288)
    return stamped("odom", at) + text("base_link") + pose + struct.pack("<6d", speed, 0, 0, 0, 0, turn) + bytes(288)


def goals(*codes: int) -> bytes:
    parts = [bytes(8) + text(f"g{code}") + struct.pack("<B", code) + text("so") for code in codes]
    return stamped("") + struct.pack("<I", len(parts)) + b"".join(parts)


def place() -> bytes:
    return stamped("map") + struct.pack("<7d", 1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def diagnostics(*parts: tuple[int, str, dict[str, str]], at: float | None = None) -> bytes:
    body = stamped("", at) + struct.pack("<I", len(parts))
    for level, name, values in parts:
        body += struct.pack("<b", level) + text(name) + text("fine") + text("") + struct.pack("<I", len(values))
        body += b"".join(text(key) + text(value) for key, value in values.items())
    return body


class Base:
    """Hears every command, however late, and sends odometry at 50 Hz."""

    def __init__(self, name: str, master: str, log: Path) -> None:
        self.log, self.do = log.open("a", buffering=1), Path(f"{log}.do")
        self.speed, self.turn, self.x, self.goal, self.quiet = 0.0, 0.0, 0.0, 0, False
        self.node = node = Node(name, master, "127.0.0.1", lambda _why: os._exit(0))
        node.subscribe("/cmd_vel", messages.TWIST, self.moved)
        node.subscribe("/e_stop", messages.BOOL, lambda body: self.note("estop", body == b"\x01"))
        node.subscribe("/move_base/cancel", messages.GOAL_ID, lambda _body: self.note("cancel"))
        self.odometry = node.advertise("/odometry/filtered", messages.ODOMETRY, "")
        self.diagnostics = node.advertise("/diagnostics_agg", messages.DIAGNOSTICS, "")
        self.status = node.advertise("/move_base/status", messages.GOAL_STATUS, "")
        self.current_goal = node.advertise("/move_base/current_goal", messages.POSE, "")
        self.current_goal.first = lambda: place() if self.goal == 1 else None

    def moved(self, body: bytes) -> None:
        self.speed, *_, self.turn = struct.unpack("<6d", body)
        self.note("cmd", f"{self.speed:.6f}", f"{self.turn:.6f}")

    def note(self, *words: object) -> None:
        self.log.write(" ".join(map(str, (time.monotonic_ns(), *words))) + "\n")

    def run(self) -> None:
        self.note("up", os.getpid())
        self.node.start()
        for number in itertools.count(1):
            time.sleep(0.02)
            if self.do.exists():
                self.obey(self.do.read_text())
            self.x += self.speed / 50
            if not self.quiet:
                self.odometry.send(odometry(self.x, speed=self.speed, turn=self.turn))
            if number % 10 == 0:
                self.status.send(goals(*([self.goal] if self.goal else [])))
            if number % 50 == 0:
                self.diagnostics.send(diagnostics((0, "/Other/husky_node: power_status", {"Charge (%)": "87.5"})))

    def obey(self, line: str) -> None:
        self.goal = {"goal active": 1, "goal done": 3}.get(line, self.goal)
        self.quiet = {"quiet": True, "loud": False}.get(line, self.quiet)
        if line == "goal active":
            self.current_goal.send(place())
        self.do.unlink()


if __name__ == "__main__":
    if sys.argv[1] == "master":
        Master(int(sys.argv[2])).run()
    else:
        Base(sys.argv[2], sys.argv[3], Path(sys.argv[4])).run()
