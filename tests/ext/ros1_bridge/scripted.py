"""A master and a base of ROS 1 in pure Python, as programs of their own; nothing of the product is in them.

``python scripted.py master PORT`` and ``python scripted.py base NAME MASTER LOG``. As ``rospy_base.py`` does with real
rospy, the base logs what it hears, a line each: ``nanoseconds cmd linear angular``, ``… estop True``, ``… cancel``, and
``… up PID`` at its start. Lines in ``LOG.do`` make it do more: ``goal active``, ``goal done``, ``quiet``, ``loud``.
"""

from __future__ import annotations

import os
import socket
import struct
import sys
import threading
import time
from pathlib import Path
from socketserver import ThreadingMixIn
from typing import Any
from xmlrpc.client import ServerProxy
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

FORMS = {
    "/cmd_vel": ("geometry_msgs/Twist", "9f195f881246fdfa2798d1d3eebca84a"),
    "/e_stop": ("std_msgs/Bool", "8b94c1b53db61fb6aed406028ad6332a"),
    "/move_base/cancel": ("actionlib_msgs/GoalID", "302881f31927c1df708a2dbab0e80ee8"),
    "/odometry/filtered": ("nav_msgs/Odometry", "cd5e73d190d741a2f92e81eda573aca7"),
    "/diagnostics_agg": ("diagnostic_msgs/DiagnosticArray", "60810da900de1dd6ddd437c3503511da"),
    "/move_base/status": ("actionlib_msgs/GoalStatusArray", "8b2b82f13216d0a8ea88bd3af735e619"),
    "/move_base/current_goal": ("geometry_msgs/PoseStamped", "d3812c3cbc69362b77dc0b19b345f8f5"),
}
HEARS, SAYS = ("/cmd_vel", "/e_stop", "/move_base/cancel"), tuple(FORMS)[3:]


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


def block(body: bytes) -> bytes:
    return struct.pack("<I", len(body)) + body


def header(**fields: str) -> bytes:
    return block(b"".join(block(f"{key}={value}".encode()) for key, value in fields.items()))


def exactly(sock: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        chunk = sock.recv(size - len(data))
        if not chunk:
            raise OSError("closed")
        data += chunk
    return data


def receive(sock: socket.socket) -> bytes:
    return exactly(sock, struct.unpack("<I", exactly(sock, 4))[0])


def text(value: str) -> bytes:
    return block(value.encode())


def stamped(frame: str) -> bytes:
    now = time.time_ns()
    return struct.pack("<III", 0, now // 10**9, now % 10**9) + text(frame)


class Base:
    """Hears every command, however late, and sends odometry at 50 Hz."""

    def __init__(self, name: str, master: str, log: Path) -> None:
        self.name, self.master, self.log, self.do = f"/{name}", master, log.open("a", buffering=1), Path(f"{log}.do")
        self.server = server()
        self.uri = f"http://127.0.0.1:{self.server.server_address[1]}/"
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.readers: dict[str, list[socket.socket]] = {topic: [] for topic in SAYS}
        self.connected: set[tuple[str, str]] = set()
        self.lock = threading.Lock()
        self.speed, self.turn, self.x, self.goal, self.quiet = 0.0, 0.0, 0.0, 0, False
        api = {"publisherUpdate": self.update, "requestTopic": self.request, "getPid": lambda _: [1, "", os.getpid()],
               "shutdown": lambda *_: os._exit(0)}  # fmt: skip
        for method, function in api.items():
            self.server.register_function(function, method)

    def run(self) -> None:
        for job in (lambda: self.server.serve_forever(0.05), self.accept):
            threading.Thread(target=job, daemon=True).start()
        self.note("up", os.getpid())
        with ServerProxy(self.master) as master:
            for topic in SAYS:
                master.registerPublisher(self.name, topic, FORMS[topic][0], self.uri)
            for topic in HEARS:
                answer: Any = master.registerSubscriber(self.name, topic, FORMS[topic][0], self.uri)
                self.update("", topic, answer[2])
        number = 0
        while True:
            time.sleep(0.02)
            number += 1
            for line in self.do.read_text().split("\n") if self.do.exists() else ():
                self.obey(line)
            self.x += self.speed / 50
            if not self.quiet:
                self.send("/odometry/filtered", self.odometry())
            if number % 10 == 0:
                self.send("/move_base/status", self.status())
            if number % 50 == 0:
                self.send("/diagnostics_agg", self.diagnostics())

    def obey(self, line: str) -> None:
        self.goal = {"goal active": 1, "goal done": 3}.get(line, self.goal)
        self.quiet = {"quiet": True, "loud": False}.get(line, self.quiet)
        if line == "goal active":
            self.send("/move_base/current_goal", self.place())
        self.do.unlink(missing_ok=True)

    def note(self, *words: object) -> None:
        self.log.write(" ".join(map(str, (time.monotonic_ns(), *words))) + "\n")

    def update(self, _caller: str, topic: str, uris: list[str]) -> list[Any]:
        for uri in uris:
            with self.lock:
                new = (topic, uri) not in self.connected and topic in HEARS
                self.connected.add((topic, uri))
            if new:
                threading.Thread(target=self.hear, args=(topic, uri), daemon=True).start()
        return [1, "", 0]

    def hear(self, topic: str, uri: str) -> None:
        try:
            with ServerProxy(uri) as proxy:
                answer: Any = proxy.requestTopic(self.name, topic, [["TCPROS"]])
            _, host, port = answer[2]
            kind, md5 = FORMS[topic]
            with socket.create_connection((host, port)) as sock:
                sock.sendall(header(callerid=self.name, topic=topic, md5sum=md5, type=kind))
                receive(sock)
                while True:
                    body = receive(sock)
                    if topic == "/cmd_vel":
                        linear, *_, angular = struct.unpack("<6d", body)
                        self.speed, self.turn = linear, angular
                        self.note("cmd", f"{linear:.6f}", f"{angular:.6f}")
                    elif topic == "/e_stop":
                        self.note("estop", body == b"\x01")
                    else:
                        self.note("cancel")
        except (OSError, ValueError, IndexError):
            pass
        finally:
            with self.lock:
                self.connected.discard((topic, uri))

    def request(self, _caller: str, topic: str, _protocols: Any) -> list[Any]:
        return [1, "", ["TCPROS", "127.0.0.1", self.listener.getsockname()[1]]] if topic in SAYS else [0, "", []]

    def accept(self) -> None:
        while True:
            sock, _ = self.listener.accept()
            fields = receive(sock)
            topic = next(topic for topic in SAYS if f"topic={topic}".encode() in fields)
            kind, md5 = FORMS[topic]
            sock.sendall(header(callerid=self.name, topic=topic, md5sum=md5, type=kind))
            self.readers[topic].append(sock)
            if topic == "/move_base/current_goal" and self.goal == 1:
                sock.sendall(block(self.place()))

    def send(self, topic: str, body: bytes) -> None:
        for sock in list(self.readers[topic]):
            try:
                sock.sendall(block(body))
            except OSError:
                self.readers[topic].remove(sock)

    def place(self) -> bytes:
        return stamped("map") + struct.pack("<7d", 1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0)

    def odometry(self) -> bytes:
        pose = struct.pack("<7d", self.x, 0.5, 0.0, 0.0, 0.0, 0.0, 1.0) + bytes(288)
        return (
            stamped("odom")
            + text("base_link")
            + pose
            + struct.pack("<6d", self.speed, 0, 0, 0, 0, self.turn)
            + bytes(288)
        )

    def status(self) -> bytes:
        goal = bytes(8) + text("goal-1") + struct.pack("<B", self.goal) + text("on its way")
        return stamped("") + (struct.pack("<I", 1) + goal if self.goal else struct.pack("<I", 0))

    def diagnostics(self) -> bytes:
        part = struct.pack("<b", 0) + text("/Other/husky_node: power_status") + text("ok") + text("")
        return stamped("") + struct.pack("<I", 1) + part + struct.pack("<I", 1) + text("Charge (%)") + text("87.5")


if __name__ == "__main__":
    if sys.argv[1] == "master":
        Master(int(sys.argv[2])).run()
    else:
        Base(sys.argv[2], sys.argv[3], Path(sys.argv[4])).run()
