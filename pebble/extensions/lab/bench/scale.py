"""Measures what 10, 100 and 1,000 boards cost a server of the operator page, and a hub: CPU, memory and latency.

``page``: boards at a stock mosquitto, a page server and one viewer. ``hub``: the same boards at a Zenoh hub, and one
subscriber to everything; one session carries them all, as a gateway does, because boards speak MQTT alone. They are
cheap, all on one thread: a connection and a will each, retained capabilities, four heartbeats a second, and nothing
that obeys. The latency is that of a voltage, from the publish call of one more board until the viewer, or the
subscriber, has it; one that the page has replaced by a newer one is lost.

``python -m pebble.extensions.lab.bench.scale mqtt|zenoh WHERE COUNT`` are the boards; ``WHERE`` is a broker's port or a
hub's folder.
"""

from __future__ import annotations

import json
import resource
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
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
from pebble.extensions.lab.rig.processes import BROKERS, HOST, OPERATORS, Processes, Program, python
from pebble.extensions.lab.rig.testbed import PageServer
from pebble.extensions.lab.rig.worker_end import answer, serve_on_thread
from pebble.extensions.operator.client.discovery import ALL_OUTGOING
from pebble.transports import Message, QoS, Transport, ZenohSettings, create
from pebble.transports.mqtt import packets

PAGE, HUB = VARIANTS = ("page", "hub")
CPU, MEMORY, LATENCY = "CPU", "memory", "latency"
MOST: Final = 5000
PROBE_HZ: Final = 10.0
HEARTBEAT_S: Final = 0.25
_PROBE = "probe"
_KEEPALIVE_S = 10
_FILES = 64  # of a process besides one for each board
_UP_S, _LATE_S, _POLL_S = 120.0, 1.0, 0.05

Publish = Callable[[str, bytes], object]


@dataclass(frozen=True, slots=True)
class Settings:
    """Numbers of boards, and seconds of measuring each."""

    boards: Sequence[int] = (10, 100, 1000)
    seconds: float = 20.0


FULL: Final = Settings()
QUICK: Final = Settings(boards=(10, 50), seconds=3.0)


def run(settings: Settings, console: Console) -> Shown:
    """Measure all sizes. Raises PebbleError."""
    allow_files(max(settings.boards))
    results = begin("scale", settings)

    def measure(_number: int, progress: Progress) -> Iterator[Cell]:
        for boards in settings.boards:
            for variant, of in ((PAGE, page), (HUB, hub)):
                progress(f"{variant}, {boards} boards")
                yield from of(boards, settings.seconds)

    measure_rounds(results, 1, measure, console)
    return shown(results)


def shown(results: Results) -> Shown:
    """Return the tables and pictures of results."""
    own = [cell for cell in results.cells if cell.params.get("process") in (None, PAGE, HUB)]
    return Shown(results, [table(results)], plots.lines("scale", "What boards cost", own, over="boards"))


def table(results: Results) -> Table:
    """Return CPU, memory and latency for each number of boards."""
    heads = ["", "boards", "CPU %", "broker %", "boards' %", "PSS MB", "p50 ms", "p99 ms", "n", "lost"]
    grid = plain_table("Page server with one viewer, and hub: CPU of one core, memory, latency of a value", heads)
    for found in (cell for cell in results.cells if cell.measure == LATENCY):
        variant, boards = found.variant, found.params["boards"]
        used = [results.find(variant, CPU, process=name, boards=boards) for name in (variant, "broker", "boards")]
        memory = results.find(variant, MEMORY, boards=boards)
        grid.add_row(
            variant, str(boards), *(digits(one.percentile(50)) if one else "" for one in (*used, memory)),
            digits(found.percentile(50)), digits(found.percentile(99)), str(len(found.samples)), str(found.lost),
        )  # fmt: skip
    return grid


def allow_files(boards: int) -> None:
    """Let this process, and those that it starts, have a file for each board. Raises PebbleError if they may not."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needs = boards + _FILES
    if resource.RLIM_INFINITY not in (soft, hard) and needs > hard:
        raise PebbleError(
            f"{boards} boards need {needs} open files in one process, and this user may have {hard}: raise ulimit -n"
        )
    if soft != resource.RLIM_INFINITY:
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, needs), hard))


def page(boards: int, seconds: float) -> Iterator[Cell]:
    """Measure a page server with one viewer. Raises PebbleError."""
    with Processes() as processes:
        broker = processes.broker()
        broker.wait()
        server = processes.add(PageServer(processes.folder, broker.port), OPERATORS)
        server.wait()
        crowd = processes.worker("boards", "pebble.extensions.lab.bench.scale", "mqtt", broker.port, boards)
        crowd.answer(_UP_S)
        pids = {PAGE: server.pid, "broker": broker.pid, "boards": crowd.pid}
        with Viewer(server.url) as viewer:
            viewer.wait_for(boards)
            yield from _measured(PAGE, boards, seconds, pids, by_mqtt(str(broker.port), _PROBE), viewer.values)


def hub(boards: int, seconds: float) -> Iterator[Cell]:
    """Measure a hub with one subscriber. Raises PebbleError."""
    with Processes() as processes:
        own, values = ZenohSettings(run_dir=processes.folder / "z"), dict[float, int]()
        command = python("pebble.runtime.hub", msgspec.json.encode(own, enc_hook=str).decode())
        program = processes.add(Program("hub", command, processes.folder / "hub.log"), BROKERS)
        program.wait_until((own.run_dir / "hub.sock").exists, _UP_S)
        crowd = processes.worker("boards", "pebble.extensions.lab.bench.scale", "zenoh", own.run_dir, boards)
        crowd.answer(_UP_S)

        def receive(message: Message) -> None:
            if message.topic.endswith(CHARGING_LEVEL.suffix):
                values.setdefault(json.loads(message.payload)["value"], time.monotonic_ns())

        with at_hub(own.run_dir, "subscriber") as subscriber, at_hub(own.run_dir, _PROBE) as probe:
            subscriber.subscribe(ALL_OUTGOING, receive, direct=True)
            pids = {HUB: program.pid, "boards": crowd.pid}
            yield from _measured(HUB, boards, seconds, pids, by_zenoh(probe), values)


def _measured(
    variant: str, boards: int, seconds: float, pids: Mapping[str, int], publish: Publish, values: Mapping[float, int]
) -> Iterator[Cell]:
    """Publish values for some seconds; ``values`` is when each has arrived."""
    params, topic, sent = {"boards": boards}, CHARGING_LEVEL.topic(_base(_PROBE)), dict[float, int]()
    end = time.monotonic() + _UP_S
    while not values:
        if time.monotonic() > end:
            raise PebbleError(f"{variant}, {boards} boards: no value arrived within {_UP_S:.0f} s")
        publish(topic, _voltage(0.0))
        time.sleep(_POLL_S)
    before, began = {name: cpu_s([pid]) for name, pid in pids.items()}, time.monotonic()
    for number in range(round(seconds * PROBE_HZ)):
        time.sleep(max(0.0, began + number / PROBE_HZ - time.monotonic()))
        value = round(7 + number / 1000, 3)
        sent[value] = time.monotonic_ns()
        publish(topic, _voltage(value))
    took = time.monotonic() - began
    for name, pid in pids.items():
        yield round_cell(variant, CPU, "%", [100 * (cpu_s([pid]) - before[name]) / took], {**params, "process": name})
    yield round_cell(variant, MEMORY, "MB", [pss_mb(pids[variant])], params)
    time.sleep(_LATE_S)
    arrived = [(values[value] - ns) / 1e6 for value, ns in sent.items() if value in values]
    yield round_cell(variant, LATENCY, "ms", arrived, params, sent=len(sent))


class Viewer:
    """A viewer of the operator page without a browser, which answers pings. Times are CLOCK_MONOTONIC, ns."""

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

    def wait_for(self, boards: int) -> None:
        """Wait until the page shows so many boards as online. Raises PebbleError."""
        end = time.monotonic() + _UP_S
        while len(self._online) < boards:
            if time.monotonic() > end:
                raise PebbleError(f"the page shows {len(self._online)} of {boards} boards")
            time.sleep(_POLL_S)

    def _send(self, op: str, **fields: Any) -> None:
        self._socket.send(json.dumps({"op": op, **fields}))

    def _read(self) -> None:
        for text in self._socket:  # ends with the connection
            message = json.loads(text)
            if message["op"] == "ping":
                self._send("echo", n=message["n"], t=time.monotonic() * 1000)
            for ref, metric, value, _ in message["set"] if message["op"] == "state" else ():
                if metric == "web/liveness" and value["online"]:
                    self._online.add(ref)
                elif metric == CHARGING_LEVEL.metric:
                    self.values.setdefault(value["value"], time.monotonic_ns())


# -- the boards


def by_mqtt(port: str, name: str) -> Publish:
    """Connect a board to a broker, which it asks for nothing. Raises PebbleError."""
    sock = socket.create_connection((HOST, int(port)))
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.sendall(packets.connect(name, modern=False, bridge=False, keepalive_s=_KEEPALIVE_S, will=_will(name),
                                 username=None, password=None))  # fmt: skip
    if sock.recv(4)[3:] != b"\0":
        raise PebbleError(f"the broker does not admit {name}: it may open no more files")
    return lambda topic, payload: sock.sendall(
        packets.publish(topic, payload, 0, 0, retain=True, modern=False, expires_s=None)
    )


def at_hub(run_dir: Path, name: str) -> Transport:
    """Return a session with a hub, not yet opened."""
    return create("zenoh", name, ZenohSettings(run_dir=run_dir, client=True))


def by_zenoh(session: Transport) -> Publish:
    return lambda topic, payload: session.publish(topic, payload, qos=QoS.LATEST, retain=True)


def _base(name: str) -> str:
    return Identity("pebble", "robots", name).base


def _will(name: str) -> Message:
    return Message(ONLINE.topic(_base(name)), b'{"t": 0, "online": false}', QoS.DELIVERED, retain=True)


def _voltage(value: float) -> bytes:
    return json.dumps({"value": value, "unit": "v"}).encode()


def capabilities(identity: Identity) -> bytes:
    """Return those of a board that drives, as its payload."""
    drive = {"available": True, "controls": True, "axes": ["x", "z", "y"], "topic": DRIVE.topic(identity.base)}
    value = {"identity": msgspec.to_builtins(identity), "transport": {"kind": "mqtt"}, "drive": drive}
    return json.dumps({"schema": "pebble-capabilities/v1", "t": _epoch_ms(), "value": value}).encode()


def _epoch_ms() -> int:
    return int(1000 * time.time())


def main(kind: str, where: str, count: int) -> None:
    """Run boards until standard input closes; their heartbeats are evenly spread."""
    ended, boards = serve_on_thread(lambda _line: None), list[tuple[str, Publish]]()
    gateway = None if kind == "mqtt" else by_zenoh(at_hub(Path(where), "gateway").open(_UP_S))
    for number in range(count):
        identity = Identity("pebble", "robots", f"board-{number:04d}")
        publish = gateway or by_mqtt(where, identity.id)
        publish(CAPABILITIES.topic(identity.base), capabilities(identity))
        boards.append((ONLINE.topic(identity.base), publish))
    answer({"ready": True})
    due = time.monotonic()
    while not ended.is_set():
        for topic, publish in boards:
            due = max(due + HEARTBEAT_S / count, time.monotonic() - HEARTBEAT_S)
            time.sleep(max(0.0, due - time.monotonic()))
            publish(topic, b'{"t": %d, "online": true}' % _epoch_ms())


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
