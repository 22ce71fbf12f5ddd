"""What an attacker tries who may publish at the broker, and a page that floods the server."""

from __future__ import annotations

import itertools
import json
import re
import signal
import socket
import threading
import time
import urllib.request
from collections.abc import Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from pebble.extensions.page.robots import MAX_COMPONENTS
from tests.commands.command_line import program
from tests.ext.page.served import FREE, Page
from tests.kit import mqtt_bytes
from tests.kit.played_robot import RecordingRobot
from tests.support import Broker, until

GOOB = "pebble/robots/goob"
VICTIM = "pebble/robots/victim"
NUMBERS = itertools.count(1)
MB = 1024 * 1024
PATIENCE_S = 60  # with a machine that does much else


class ServerProcess:
    """``pebble web`` as a process of its own, whose memory can be measured."""

    def __init__(self, broker_port: int, folder: Path) -> None:
        url = f"mqtt://127.0.0.1:{broker_port}"
        self._process = program("web", "--url", url, "--port", "0", "--people", folder / "people.sqlite")
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        self.port = int(line.split()[5].rstrip("/").rpartition(":")[2])
        self.origin = f"http://127.0.0.1:{self.port}"
        with urllib.request.urlopen(f"{self.origin}/") as page:
            found = re.search(r'name="pebble-version" content="(\w+)"', page.read().decode())
        assert found is not None
        self.version = found[1]

    def page(self, **options: Any) -> Page:
        return Page(self, **options)  # type: ignore[arg-type]

    def memory(self) -> int:
        """Resident bytes."""
        status = Path(f"/proc/{self._process.pid}/status").read_text()
        return 1024 * int(status.partition("VmRSS:")[2].split()[0])

    def close(self) -> str:
        """End it; what it wrote to stderr."""
        self._process.send_signal(signal.SIGINT)
        assert self._process.wait(20) == 130
        assert self._process.stderr is not None
        return self._process.stderr.read()


@pytest.fixture(scope="module")
def server(broker: Broker, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServerProcess]:
    """One for all attacks: each meets what those before have left behind."""
    running = ServerProcess(broker.port, tmp_path_factory.mktemp("people"))
    yield running
    written = running.close()
    assert "Traceback" not in written, written


def flood(port: int, messages: Iterable[tuple[str, bytes]]) -> int:
    """Publish everything with QoS 0, as fast as the broker takes it."""
    count = 0
    with socket.create_connection(("127.0.0.1", port), 30) as client:
        client.sendall(mqtt_bytes.connect(None, None))
        assert client.recv(4) == b"\x20\x02\x00\x00"
        for topic, payload in messages:
            client.sendall(mqtt_bytes.publish(topic, payload))
            count += 1
        client.sendall(mqtt_bytes.packet(0xC0, b""))
        assert client.recv(2) == b"\xd0\x00", "the broker has taken everything"
    return count


def drives(page: Page, robot: RecordingRobot) -> bool:
    """Whether the page can still take the lease, move the robot and stop it. It may be tried again."""
    page.send("watch", ref=robot.base)
    if not (page.knows(robot.base, 10) and page.ready() and page.take(robot.base)):
        return False
    gesture = next(NUMBERS)  # greater than all before: the server has ended those
    since = time.monotonic()
    end = since + 5
    while time.monotonic() < end and not any(one["z"] for one in robot.drives(since)):
        page.drive(robot.base, gesture, z=0.5)
        time.sleep(0.05)
    page.drive(robot.base, gesture)
    moved = any(one["z"] for one in robot.drives(since))
    return moved and until(lambda: robot.drives()[-1]["z"] == 0, 3)


def online(t: int = 1) -> bytes:
    return b'{"t":%d,"online":true}' % t


def many_topics() -> Iterator[tuple[str, bytes]]:
    """100,000 topics: components, and metrics, owners and devices of one component."""
    for number in range(60_000):
        yield f"pebble/robots/x{number}/outgoing/online", online()
    state = {"latched": True, "boot": "b", "count": 1, "recent": [], "by": "x", "why": "", "since": 1}
    payload = json.dumps({**state, "persisted": True, "reset_refused": None}).encode()
    for number in range(20_000):
        yield f"{GOOB}/outgoing/estop/o{number}", payload
    for number in range(20_000):
        yield f"pebble/robots/y{number}/outgoing/status", b'{"value":{}}'


def test_large_and_odd_values(server: ServerProcess, broker: Broker) -> None:
    with RecordingRobot(broker.port, VICTIM) as robot, server.page() as page:
        page.send("watch", ref=VICTIM)
        assert drives(page, robot)
        before = server.memory()
        sizes = (10, 60_000, 70_000, 1_000_000)
        large = (
            (f"pebble/robots/z{number}/outgoing/{metric}", b'{"value":"' + b"x" * sizes[number % 4] + b'"}')
            for number in range(600)
            for metric in ("status", "capabilities")
        )
        flood(broker.port, large)
        flood(broker.port, ((f"{VICTIM}/outgoing/{metric}", payload) for payload in ODD for metric in METRICS))
        robot.publish("status", {"value": {"last": 1}})
        assert until(lambda: page.value(VICTIM, "status", "value") == {"last": 1}, 20), "what pages get is no JSON"
        assert until(lambda: drives(page, robot), 15, step=0.5)  # a gesture that began among 300 MB has ended
        assert until(lambda: server.memory() - before < 120 * MB, 10)
        assert not page.closed, page.bye


METRICS = ("status", "charging-status", "sensors/imu", "wheel-odometry", "logs", "mcu/x/describe", "autonomy-status")
ODD = (
    b"",
    b"{",
    b"\xff\xfe",
    b'{"value":"\xff"}',
    b'{"value":NaN}',
    b'{"t":1e999}',
    b'{"value":"\\ud800"}',
    b'{"value":' + b"[" * 30_000 + b"]" * 30_000 + b"}",
    b"[" * 60_000,
    b'{"value":1,"value":{"value":null}}',
    b'{"__proto__":{"x":1}}',
    b"null",
    b"\x00",
    b'{"value":"\x00"}',
    b"9" * 60_000,
    b'{"t":' + b"9" * 5000 + b"}",
)


LARGE = b'{"t":1,"value":{"drive":{"available":true},"estop":{"available":true,"owners":["s"]},"a":"%s"}}'

#: What strangers publish of each of their 600 components, all the time. Those who publish all that a robot does cannot
#: be told from one: access lists at the broker are for that.
STRANGERS = {
    "capabilities": LARGE % (b"x" * 60_000),
    "estop/s": json.dumps(FREE | {"latched": True, "persisted": True}).encode(),
}
SHARE = 8  # of the time that the broker is left to others, for each second in which it takes the crowd's messages


class Crowd:
    """600 components of a stranger, each of which publishes the same all the time."""

    def __init__(self, port: int, metric: str, payload: bytes) -> None:
        self._port, self._payload = port, payload
        self._topics = [f"pebble/robots/e{next(NUMBERS)}/outgoing/{metric}" for _ in range(600)]
        self._ending = threading.Event()
        self._took_s = 0.0
        self._publish()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self) -> None:
        self._ending.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ending.wait(max(2, SHARE * self._took_s)):
            self._publish()

    def _publish(self) -> None:
        """The next round waits longer where the broker takes longer: else a busy machine would only meet a queue."""
        began = time.monotonic()
        flood(self._port, ((topic, self._payload) for topic in self._topics))
        self._took_s = time.monotonic() - began


def new_robot(broker: Broker, **options: Any) -> RecordingRobot:
    return RecordingRobot(broker.port, f"pebble/robots/robot-{next(NUMBERS)}", **options)


def is_stopped(page: Page, robot: RecordingRobot, ref: str) -> bool:
    """Whether the stop of a robot, or of all, reaches this one, which was not stopped before."""
    assert not robot.latched
    page.send("estop", ref=ref, stop=(name := f"{next(NUMBERS):016x}"), why="x")
    stopped = until(lambda: robot.latched, PATIENCE_S)
    page.send("estop-end", stop=name)  # one of all would collect robots of later tests
    return stopped


@pytest.mark.parametrize(("metric", "payload"), STRANGERS.items(), ids=STRANGERS)
def test_a_crowd_of_strangers_hides_no_robot_that_is_opened_and_keeps_no_stop_from_any(
    broker: Broker, server: ServerProcess, metric: str, payload: bytes
) -> None:
    with closing(Crowd(broker.port, metric, payload)), server.page() as page:
        with new_robot(broker) as robot:
            robot.publish("estop/serial", FREE, retain=True)  # as its motor owner does when it begins
            page.send("watch", ref=robot.base)
            assert page.knows(robot.base, PATIENCE_S)
            assert is_stopped(page, robot, ""), "by a stop of all"
        with new_robot(broker) as robot:
            page.send("watch", ref=robot.base)
            assert page.knows(robot.base, PATIENCE_S), "without a state of a stop, as what has no motors"
            assert until(lambda: page.value(robot.base, "capabilities"), 10), "asked for again"
        with new_robot(broker, capabilities={}) as robot:
            assert is_stopped(page, robot, robot.base), "by its own stop, known or not"


@pytest.mark.thorough
def test_a_hundred_thousand_topics(server: ServerProcess, broker: Broker) -> None:
    with RecordingRobot(broker.port, VICTIM) as robot, server.page() as page:
        assert drives(page, robot)
        before = server.memory()
        assert flood(broker.port, many_topics()) == 100_000
        assert until(lambda: page.value("", "web/broker", "robots_omitted") > 1000, 30)
        assert until(lambda: drives(page, robot), 60)
        assert until(lambda: server.memory() - before < 60 * MB, 10)
        with server.page() as another:
            assert another.knows(VICTIM, PATIENCE_S)
            assert len({ref for ref, _ in another.state}) <= MAX_COMPONENTS + 10, "and what was opened"
