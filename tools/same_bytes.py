"""Does a robot without new config keys send what it sent at another commit? ``python tools/same_bytes.py COMMIT``

A whole robot of that commit, again that one, and one of this tree are each driven, stopped, reset and watched. Between
each and both of its brokers, the remote and its own one, is a proxy that records every MQTT packet of the robot. What
the first two runs differ in is chance; any other difference is listed, and the exit code is 1. Numbers, times, random
ids, probes and temporary paths are masked, so counts are compared only roughly. Reports of what is being done depend on
the moment: of these the fields and their types count; subscriptions count filter by filter.
"""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
TYPES = (
    "", "CONNECT", "CONNACK", "PUBLISH", "PUBACK", "", "", "", "SUBSCRIBE", "SUBACK", "UNSUBSCRIBE", "UNSUBACK",
    "PINGREQ", "PINGRESP", "DISCONNECT", "",
)  # fmt: skip
MASKS = [
    (re.compile(rb"^[ \t]{32}$"), b"PROBE"),
    (re.compile(rb"[ \t]{32}$"), b"+PROBE"),
    (re.compile(rb"/tmp/[^\"\s,]*"), b"/PATH"),
    (re.compile(rb"\b[0-9a-f]{8,}\b|(?<=-)[0-9a-f]{8,}|(?<=_)[0-9a-f]{8,}"), b"HEX"),
    (re.compile(rb"-?\d+(\.\d+)?(e-?\d+)?"), b"0"),
]
REPORTS = re.compile(rb"/outgoing/(status|media-status|media-report/.*|log.*)$")  # of what is being done
MOMENT = (".last_error", ".reduced")  # none, or "no frame for 2 s" and "rate 1/2": the load of the moment decides
ROUGHLY = 2.0  # factor by which counts of one packet may differ, beyond
FEW = 5


class Recorder:
    """A proxy on loopback. ``packets``: of all clients, masked, by the client's name; ``logins``: whole CONNECTs."""

    def __init__(self, target: int) -> None:
        self._target, self.packets, self.logins = target, Counter[str](), list[bytes]()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def _accept(self) -> None:
        with suppress(OSError):
            self._pass_on()

    def _pass_on(self) -> None:
        while True:
            near, _ = self._listener.accept()
            far = socket.create_connection(("127.0.0.1", self._target))
            for end in (near, far):
                end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            threading.Thread(target=self._carry, args=(near, far, True), daemon=True).start()
            threading.Thread(target=self._carry, args=(far, near, False), daemon=True).start()

    def _carry(self, source: socket.socket, sink: socket.socket, record: bool) -> None:
        data, name = b"", "?"
        with suppress(OSError):
            while part := source.recv(65536):
                sink.sendall(part)
                data += part if record else b""
                found, data = packets(data)
                for head, body in found:
                    if TYPES[head >> 4] == "CONNECT":
                        self.logins.append(body)
                        name = masked(connect_id(body))
                    self.packets.update(f"{name}: {what}" for what in described(head, body))
            sink.shutdown(socket.SHUT_WR)


def packets(data: bytes) -> tuple[list[tuple[int, bytes]], bytes]:
    """The whole packets at the begin of a stream, first byte and content, and the rest."""
    found = []
    while len(data) >= 2:
        size = shift = at = 0
        for at, byte in enumerate(data[1:5], 1):  # noqa: B007
            size |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                break
        if len(data) < at + 1 + size:
            break
        found.append((data[0], data[at + 1 : at + 1 + size]))
        data = data[at + 1 + size :]
    return found, data


def connect_id(body: bytes) -> bytes:
    at = 2 + int.from_bytes(body[:2], "big") + 4
    return body[at + 2 : at + 2 + int.from_bytes(body[at : at + 2], "big")]


def described(head: int, body: bytes) -> Iterator[str]:
    kind = TYPES[head >> 4]
    if kind == "PUBLISH":
        size = int.from_bytes(body[:2], "big")
        topic, payload = body[2 : 2 + size], body[2 + size + (2 if head & 6 else 0) :]
        about = f"PUBLISH retain={head & 1} qos={head >> 1 & 3} {masked(topic)}"
        if topic.endswith((b"front-camera", b"outgoing/audio")) and len(payload) > 500:
            yield f"{about} MEDIA"
        elif REPORTS.search(topic):
            yield from (f"{about} {field}" for field in fields(json.loads(payload)))
        else:
            yield f"{about} {masked(payload)}"
    elif kind in ("SUBSCRIBE", "UNSUBSCRIBE"):
        at = 2
        while at < len(body):
            end = at + 2 + int.from_bytes(body[at : at + 2], "big")
            qos = f" qos={body[end]}" if kind == "SUBSCRIBE" else ""
            yield f"{kind} {masked(body[at + 2 : end])}{qos}"
            at = end + (1 if qos else 0)
    elif kind == "CONNECT":
        at = 2 + int.from_bytes(body[:2], "big")
        level, flags, keepalive = body[at], body[at + 1], int.from_bytes(body[at + 2 : at + 4], "big")
        yield f"{kind} level={level} flags={flags:08b} keepalive={keepalive} {masked(body[at + 4 :])}"
    else:
        yield kind


def fields(value: Any, path: str = "") -> Iterator[str]:
    if isinstance(value, dict):
        for name, one in value.items():
            yield from fields(one, f"{path}.{name}")
    elif path.endswith(MOMENT) and (value is None or isinstance(value, str)):
        yield f"{path}: text or none"
    else:
        yield f"{path}: {'number' if isinstance(value, (int, float)) else type(value).__name__}"


def masked(data: bytes) -> str:
    for pattern, by in MASKS:
        data = pattern.sub(by, data)
    return data.decode("utf-8", "backslashreplace")


def run(tree: Path) -> Counter[str]:
    """Every packet of a robot of this tree; Python's packages are those of this interpreter."""
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    from pebble.extensions.lab.rig.processes import Processes  # the brokers are no part of what is compared

    with Processes() as processes:
        brokers = processes.broker("remote"), processes.broker("local")
        for broker in brokers:
            broker.wait()
        recorders = [Recorder(broker.port) for broker in brokers]
        ports = [str(port) for port in (brokers[0].port, *(recorder.port for recorder in recorders))]
        subprocess.run([sys.executable, __file__, "--robot", *ports], cwd=tree, env=environment, check=True)
    sides = zip(("remote", "local"), recorders, strict=True)
    return Counter({f"{side}, {what}": count for side, one in sides for what, count in one.packets.items()})


def robot(direct: int, remote: int, local: int) -> None:
    """This runs in a process of its own, with the modules of the tree that is measured."""
    from pebble import contract

    lab = "pebble.extensions.lab" if Path("pebble", "extensions", "lab").is_dir() else "pebble"  # of older trees
    clients = import_module(f"{lab}.bench.clients")
    RobotSubscriber, StockClient = clients.RobotSubscriber, clients.StockClient  # noqa: N806
    robots = import_module(f"{lab}.rig.robot")
    BASE, MEDIA, Robot = robots.BASE, robots.MEDIA, robots.Robot  # noqa: N806

    with import_module(f"{lab}.rig.processes").Processes() as processes:
        one = Robot(processes, "mqtt", ("127.0.0.1", remote), services=MEDIA, reports=True)
        one.local_port = local
        one.prepare()
        seen, client = RobotSubscriber(direct, BASE), StockClient().open(direct)
        client.wait()
        one.launch()
        one.expect(lambda: seen.ready_ns is not None, "not ready", 60)
        time.sleep(3)
        for _ in range(40):
            client.send(contract.DRIVE, BASE, {"x": 0.0, "z": 0.3})
            time.sleep(0.05)
        client.send(contract.DRIVE, BASE, {"x": 0.0, "z": 0.0})
        client.send(contract.CONTROL, BASE, {"id": "0badf00d", "by": "ann"})
        time.sleep(1)
        client.send(contract.CONTROL, BASE, {"id": "0badf00d", "by": "ann", "want": "release"})
        client.send(contract.ESTOP, BASE, {"stop": "0123456789abcdef", "by": "ann", "why": "trial"})
        time.sleep(1)
        client.request_media(BASE)
        one.expect(lambda: len(seen.arrived) > 1, "no media", 30)
        time.sleep(2)
        client.request_media(BASE, False)
        time.sleep(2)
        seen.close()
        client.close()


def differences(old: tuple[Counter[str], Counter[str]], new: Counter[str]) -> Iterator[str]:
    known, always = old[0].keys() | old[1].keys(), old[0].keys() & old[1].keys()
    yield from (f"only now: {what}" for what in sorted(new.keys() - known))
    yield from (f"no more: {what}" for what in sorted(always - new.keys()))
    for what in sorted(always & new.keys()):
        counts = sorted((old[0][what], old[1][what]))
        if not counts[0] / ROUGHLY - FEW <= new[what] <= counts[1] * ROUGHLY + FEW:
            yield f"{new[what]} times, it was {counts[0]} to {counts[1]}: {what}"


def main(commit: str) -> int:
    with tempfile.TemporaryDirectory(prefix="same-") as folder:
        archive = subprocess.run(["git", "archive", commit], cwd=ROOT, check=True, stdout=subprocess.PIPE).stdout
        subprocess.run(["tar", "-x", "-C", folder], input=archive, check=True)
        first, again, now = (run(tree) for tree in (Path(folder), Path(folder), ROOT))
    found = list(differences((first, again), now))
    print(*found, sep="\n")
    chance = len(first.keys() ^ again.keys())
    print(f"{len(now)} kinds of packets, {now.total()} in all; {chance} by chance; differences: {len(found)}")
    return int(bool(found))


if __name__ == "__main__":
    if sys.argv[1] == "--robot":
        robot(*map(int, sys.argv[2:]))
    else:
        sys.path.insert(0, str(ROOT))
        sys.exit(main(sys.argv[1]))
