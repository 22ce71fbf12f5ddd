"""Measures what 10, 100 and 1,000 boards cost a server of the operator page and its broker: CPU, memory and latency.

Boards at a stock mosquitto, a page server and one viewer. The boards are cheap, all on one thread: a connection and a
will each, retained capabilities, four heartbeats a second, and nothing that obeys. The latency is that of a voltage,
from the publish call of one more board, the probe, until the viewer has it. A voltage that the page never sent, because
a newer one replaced it, counts as lost.

``python -m pebble.extensions.lab.bench.scale PORT COUNT`` runs the boards.
"""

from __future__ import annotations

import json
import resource
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, Self
from urllib.parse import urlsplit

import msgspec
from rich.console import Console
from rich.table import Table

from pebble.contract import CAPABILITIES, CHARGING_LEVEL, DRIVE, ONLINE
from pebble.contract.identity import Identity
from pebble.errors import PebbleError
from pebble.extensions.lab.bench import plots
from pebble.extensions.lab.bench.results import Cell, Results, begin, round_cell
from pebble.extensions.lab.bench.rounds import Progress, measure_rounds
from pebble.extensions.lab.bench.show import Shown, digits, plain_table
from pebble.extensions.lab.bench.usage import cpu_s, pss_mb
from pebble.extensions.lab.rig.processes import HOST, OPERATORS, Processes
from pebble.extensions.lab.rig.scripted_operator import paced
from pebble.extensions.lab.rig.testbed import PageServer
from pebble.extensions.lab.rig.worker_end import answer, serve_on_thread
from pebble.transports import Message, QoS
from pebble.transports.mqtt import packets

PAGE, BROKER, BOARDS = PROCESSES = ("page", "broker", "boards")
CPU, MEMORY, LATENCY = "CPU", "memory", "latency"
PROBE_HZ: Final = 10.0
HEARTBEAT_S: Final = 0.25
_PROBE = "probe"
_KEEPALIVE_S = 10
_UP_S, _LATE_S = 120.0, 1.0  # for the page to show all boards; for the last voltages

Publish = Callable[[str, bytes], object]


@dataclass(frozen=True, slots=True)
class Settings:
    """The numbers of boards, and the seconds of measuring for each number."""

    boards: Sequence[int] = (10, 100, 1000)
    seconds: float = 20.0


FULL: Final = Settings()
QUICK: Final = Settings(boards=(10, 50), seconds=3.0)


def run(settings: Settings, console: Console) -> Shown:
    """Measure all sizes. Raises PebbleError."""
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))  # each process that is started has a file for each board
    results = begin("scale", settings)

    def measure_all(_number: int, progress: Progress) -> Iterator[Cell]:
        for boards in settings.boards:
            progress(f"{boards} boards")
            yield from measure(boards, settings.seconds)

    measure_rounds(results, 1, measure_all, console)
    # Of the CPU times only the page server's; latency and memory have no process.
    cells = [cell for cell in results.cells if cell.params.get("process") in (None, PAGE)]
    return Shown(results, [table(results)], plots.lines("scale", "What boards cost", cells, over="boards"))


def table(results: Results) -> Table:
    """Return CPU, memory and latency for each number of boards."""
    heads = ["boards", "CPU %", "broker %", "boards' %", "PSS MB", "p50 ms", "p99 ms", "n", "lost"]
    grid = plain_table("Page server with one viewer: CPU of one core, memory, latency of a value", heads)
    for delay in (cell for cell in results.cells if cell.measure == LATENCY):
        boards = delay.params["boards"]
        cpu = [results.find(PAGE, CPU, process=name, boards=boards) for name in PROCESSES]
        memory = results.find(PAGE, MEMORY, boards=boards)
        grid.add_row(
            str(boards), *(digits(cell.percentile(50)) if cell else "" for cell in (*cpu, memory)),
            digits(delay.percentile(50)), digits(delay.percentile(99)), str(len(delay.samples)), str(delay.lost),
        )  # fmt: skip
    return grid


def measure(boards: int, seconds: float) -> Iterator[Cell]:
    """Publish values for some seconds; yield the usage of a page server with one viewer. Raises PebbleError."""
    with Processes() as processes:
        broker = processes.broker()
        broker.wait()
        server = processes.add(PageServer(processes.folder, broker.port), OPERATORS)
        server.wait()
        crowd = processes.worker("boards", "pebble.extensions.lab.bench.scale", broker.port, boards)
        crowd.answer(_UP_S)
        pids = dict(zip(PROCESSES, (server.pid, broker.pid, crowd.pid), strict=True))
        with Viewer(server.url) as viewer:
            params, topic = {"boards": boards}, CHARGING_LEVEL.topic(_base(_PROBE))
            publish = connected(broker.port, _PROBE)
            server.wait_until(lambda: viewer.online >= boards, _UP_S)
            publish(topic, _voltage(0.0))  # from the first one on the page knows the probe
            server.wait_until(lambda: bool(viewer.values), _UP_S)
            before, began = {name: cpu_s([pid]) for name, pid in pids.items()}, time.monotonic()
            sent_ns: dict[float, int] = {}  # by value: each is sent once
            for number in paced(seconds, PROBE_HZ):
                value = round(7 + number / 1000, 3)
                sent_ns[value] = time.monotonic_ns()
                publish(topic, _voltage(value))
            took = time.monotonic() - began
            for name, pid in pids.items():
                used = 100 * (cpu_s([pid]) - before[name]) / took
                yield round_cell(PAGE, CPU, "%", [used], {**params, "process": name})
            yield round_cell(PAGE, MEMORY, "MB", [pss_mb(server.pid)], params)
            time.sleep(_LATE_S)
            latencies = [(viewer.values[value] - ns) / 1e6 for value, ns in sent_ns.items() if value in viewer.values]
        yield round_cell(PAGE, LATENCY, "ms", latencies, params, sent=len(sent_ns))


class Viewer:
    """A viewer of the operator page without a browser; it answers pings. Times are CLOCK_MONOTONIC, ns."""

    def __init__(self, url: str) -> None:
        from websockets.sync.client import connect  # optional

        host = urlsplit(url).netloc
        options: dict[str, Any] = {"origin": f"http://{host}", "compression": None, "max_size": None}
        self._socket = connect(f"ws://{host}/ws/control", **options)
        self.values: dict[float, int] = {}  # when each voltage was shown
        self._online: set[str] = set()
        self._send("hello", version="")
        self._thread = threading.Thread(target=self._read, name="viewer", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()
        self._thread.join()

    @property
    def online(self) -> int:
        """Number of robots that the page shows as online."""
        return len(self._online)

    def _send(self, op: str, **fields: Any) -> None:
        self._socket.send(json.dumps({"op": op, **fields}))

    def _read(self) -> None:
        for text in self._socket:  # ends with the connection
            message = json.loads(text)
            if message["op"] == "ping":
                self._send("echo", n=message["n"], t=time.monotonic() * 1000)
            if message["op"] != "state":
                continue
            for ref, metric, value, _ in message["set"]:
                if metric == "web/liveness" and value["online"]:
                    self._online.add(ref)
                elif metric == CHARGING_LEVEL.metric:
                    self.values.setdefault(value["value"], time.monotonic_ns())


# -- the boards


def connected(port: int, name: str) -> Publish:
    """Connect a board to a broker, without subscriptions; return its publish function. Raises PebbleError."""
    sock = socket.create_connection((HOST, port))
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    will = Message(ONLINE.topic(_base(name)), b'{"t": 0, "online": false}', QoS.DELIVERED, retain=True)
    sock.sendall(packets.connect(name, modern=False, bridge=False, keepalive_s=_KEEPALIVE_S, will=will,
                                 username=None, password=None))  # fmt: skip
    if sock.recv(4)[3:] != b"\0":  # the return code of a CONNACK
        raise PebbleError(f"the broker does not admit {name}: it may open no more files")
    return lambda topic, payload: sock.sendall(
        packets.publish(topic, payload, 0, 0, retain=True, modern=False, expires_s=None)
    )


def _base(name: str) -> str:
    return Identity("pebble", "robots", name).base


def _voltage(value: float) -> bytes:
    return json.dumps({"value": value, "unit": "v"}).encode()


def capabilities(identity: Identity) -> bytes:
    """Return the payload of the capabilities of a board that drives."""
    drive = {"available": True, "controls": True, "axes": ["x", "z", "y"], "topic": DRIVE.topic(identity.base)}
    value = {"identity": msgspec.to_builtins(identity), "transport": {"kind": "mqtt"}, "drive": drive}
    return json.dumps({"schema": "pebble-capabilities/v1", "t": int(1000 * time.time()), "value": value}).encode()


def main(port: int, count: int) -> None:
    """Run boards, whose heartbeats are spread evenly, until standard input closes."""
    ended, boards = serve_on_thread(lambda _line: None), list[tuple[str, Publish]]()
    for number in range(count):
        identity = Identity("pebble", "robots", f"board-{number:04d}")
        publish = connected(port, identity.id)
        publish(CAPABILITIES.topic(identity.base), capabilities(identity))
        boards.append((ONLINE.topic(identity.base), publish))
    answer({"ready": True})
    due = time.monotonic()
    while not ended.is_set():
        for topic, publish in boards:
            due = max(due + HEARTBEAT_S / count, time.monotonic() - HEARTBEAT_S)  # catches up one period at most
            time.sleep(max(0.0, due - time.monotonic()))
            publish(topic, b'{"t": %d, "online": true}' % int(1000 * time.time()))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
