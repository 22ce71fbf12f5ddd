"""Three linked hubs as processes: each will once, hubs that hang or are killed, and a separation that heals.

One of each in the normal run; `make fleet` has the series (`PEBBLE_THOROUGH=1`).
"""

from __future__ import annotations

import os
import random
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

from pebble.transports import Message, QoS, State, Transport, ZenohSettings, create
from pebble.transports.zenoh import wire
from tests.support import free_port, until
from tests.tcp_proxy import TcpProxy
from tests.transports.forked import Forked
from tests.transports.zenoh.mesh_robots import HEARTBEAT, WILL

NAMES = "abc"
THOROUGH = bool(os.environ.get("PEBBLE_THOROUGH"))
LARGE = bytes(1_500_000)  # more than one message between two hubs
#: Longer than any hub waits with a will, and what is due then takes a moment.
QUIET_S = 8.0


class Hub:
    """`python -m pebble.runtime.hub` with a journal, on a port of its own."""

    def __init__(self, folder: Path, name: str) -> None:
        self.port = free_port()
        self.endpoint = f"tcp/127.0.0.1:{self.port}"
        self.settings = ZenohSettings(
            run_dir=folder / name, listen=(self.endpoint,), journal=folder / f"{name}.journal"
        )
        self._process: Forked | None = None

    def start(self, others: list[str]) -> None:
        settings = replace(self.settings, connect=tuple(others))
        self._process = Forked("pebble.runtime.hub", [msgspec.json.encode(settings, enc_hook=str).decode()])

    def kill(self) -> None:
        if self._process is not None:
            process, self._process = self._process, None
            os.kill(process.pid, signal.SIGCONT)
            process.kill()
            process.wait(10)

    def signal(self, number: int) -> None:
        assert self._process is not None
        os.kill(self._process.pid, number)


class Listener:
    """A client of one hub that counts wills and heartbeats, by robot."""

    def __init__(self, mesh: Mesh, hub: str) -> None:
        self.wills: Counter[str] = Counter()
        self.began = time.monotonic()
        self.seen: list[tuple[float, str, bool]] = []  # for the message of a test that fails
        self.heartbeats: dict[str, int] = {}
        self.client = mesh.client(f"listener-{hub}", [hub])
        self.client.subscribe(HEARTBEAT.format("+"), self._take)

    def _take(self, message: Message) -> None:
        robot = message.topic.split("/")[2]
        if message.payload == WILL:
            self.wills[robot] += not message.retain  # a copy of it comes as often as a hub does
            self.seen.append((round(time.monotonic() - self.began, 2), robot, message.retain))
        else:
            self.heartbeats[robot] = self.heartbeats.get(robot, 0) + 1


class Mesh:
    """Hubs, each linked to the others; the last one through proxies, which can be cut."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.hubs = {name: Hub(folder, name) for name in NAMES}
        self.links = [TcpProxy(self.hubs[name].port) for name in NAMES[:-1]]
        self._clients: list[Transport] = []
        self._robots: dict[str, Forked] = {}
        for name in NAMES:
            self.start(name)

    def start(self, name: str) -> None:
        if name == NAMES[-1]:
            others = [f"tcp/127.0.0.1:{link.port}" for link in self.links]
        else:
            others = [hub.endpoint for other, hub in self.hubs.items() if other not in (name, NAMES[-1])]
        self.hubs[name].start(others)
        probe = self.client("probe", [name])
        probe.close()

    def client(self, name: str, hubs: str | list[str], *, will: Message | None = None) -> Transport:
        connect = tuple(self.hubs[one].endpoint for one in hubs)
        settings = ZenohSettings(run_dir=self.folder / "clients", connect=connect, client=True)
        client = create("zenoh", name, settings, will=will).open(20)
        assert until(lambda: client.state is State.CONNECTED, 30), client.problem
        self._clients.append(client)
        return client

    def robots(self, home: str, *names: str) -> None:
        """A process of robots that connect to ``home`` first."""
        order = [home, *NAMES.replace(home, "")]
        endpoints = ",".join(self.hubs[one].endpoint for one in order)
        process = Forked("tests.transports.zenoh.mesh_robots", endpoints, ",".join(names))
        assert process.stdout.readline() == "up\n"
        self._robots |= dict.fromkeys(names, process)

    def kill_robot(self, name: str) -> None:
        process = self._robots.pop(name)
        process.kill()
        process.wait(10)

    def retained(self, hub: str, filter_: str) -> dict[str, bytes]:
        """What a client that comes late is told, by the last level of the topic."""
        found: dict[str, bytes] = {}
        with create("zenoh", "late", replace(self.hubs[hub].settings, client=True, listen=(), journal=None)) as late:
            assert until(lambda: late.state is State.CONNECTED), late.problem
            late.subscribe(filter_, lambda message: found.update({message.topic.rpartition("/")[2]: message.payload}))
            time.sleep(0.3)
        return found

    def stop(self) -> None:
        for process in self._robots.values():
            process.kill()
        for client in self._clients:
            client.close()
        for hub in self.hubs.values():
            hub.kill()
        for link in self.links:
            link.stop()


class Watch:
    """An listener at each of several hubs."""

    def __init__(self, mesh: Mesh, hubs: str = NAMES) -> None:
        self._mesh = mesh
        self._listeners = {hub: Listener(mesh, hub) for hub in hubs}

    def begin(self) -> None:
        for listener in self._listeners.values():
            listener.wills.clear()
            listener.seen.clear()
            listener.began = time.monotonic()

    def leave(self, hub: str) -> None:
        self._listeners.pop(hub).client.close()

    def enter(self, hub: str) -> None:
        self._listeners[hub] = Listener(self._mesh, hub)

    @property
    def wills(self) -> dict[str, dict[str, int]]:
        return {hub: dict(+listener.wills) for hub, listener in self._listeners.items()}

    @property
    def seen(self) -> dict[str, list[tuple[float, str, bool]]]:
        return {hub: listener.seen for hub, listener in self._listeners.items()}

    def saw(self, wills: dict[str, int]) -> bool:
        """Whether every listener has seen, or will soon see, exactly these."""
        return until(lambda: all(seen == wills for seen in self.wills.values()), QUIET_S)

    def receives(self, *robots: str) -> bool:
        """Whether everyone has a new heartbeat of each soon."""
        for listener in self._listeners.values():
            listener.heartbeats.clear()
        return until(
            lambda: all(set(robots) <= listener.heartbeats.keys() for listener in self._listeners.values()), 15
        )


@pytest.fixture
def mesh(tmp_path: Path) -> Iterator[Mesh]:
    made = Mesh(tmp_path)
    try:
        yield made
    finally:
        made.stop()


class TestWills:
    @pytest.mark.alone
    @pytest.mark.parametrize(
        ("others", "kills"),
        [
            pytest.param(2, ("robot", "hub", "both"), id="one of each"),
            pytest.param(
                10, ("robot", "hub", "both") * 20, id="sixty", marks=[pytest.mark.thorough, pytest.mark.timeout(1800)]
            ),
        ],
    )
    def test_each_is_published_once_and_none_of_a_robot_that_runs(
        self, mesh: Mesh, others: int, kills: tuple[str, ...]
    ) -> None:
        chosen = random.Random(4)
        running = {name: [f"{name}{number}" for number in range(2)] for name in NAMES}
        for name in NAMES:
            mesh.robots(name, *(f"{name}-more{number}" for number in range(others)))
            for robot in running[name]:
                mesh.robots(name, robot)
        watch = Watch(mesh)
        for number, kill in enumerate(kills):
            name = NAMES[number % 3]
            robot = chosen.choice(running[name])
            watch.begin()
            if kill != "robot":
                mesh.hubs[name].kill()
                watch.leave(name)
            if kill != "hub":
                mesh.kill_robot(robot)
            expected = {} if kill == "hub" else {robot: 1}
            assert watch.saw(expected), (number, kill, robot, watch.seen)
            if kill != "robot":
                mesh.start(name)
            time.sleep(QUIET_S)  # nor does a hub that comes back publish one again
            assert watch.saw(expected), (number, kill, robot, watch.seen)
            if kill != "hub":
                mesh.robots(name, robot)
            if kill != "robot":
                watch.enter(name)
            assert watch.receives(robot)

    @pytest.mark.alone
    @pytest.mark.thorough
    def test_a_hub_that_makes_its_socket_anew_loses_none(self, mesh: Mesh) -> None:
        """Its session is closed while a will is due, as with a renewed certificate."""
        mesh.robots("a", "a0")
        mesh.robots("a", "a1")
        watch = Watch(mesh, "bc")
        assert watch.receives("a0", "a1")
        watch.begin()
        (mesh.hubs["a"].settings.run_dir / "hub.sock").unlink()
        time.sleep(0.8)  # it looks each second
        mesh.kill_robot("a0")
        time.sleep(QUIET_S)
        assert watch.saw({"a0": 1}), watch.seen
        assert watch.receives("a1")

    @pytest.mark.alone
    @pytest.mark.parametrize(
        "hangs",
        [
            pytest.param(1, id="once"),
            pytest.param(12, marks=[pytest.mark.thorough, pytest.mark.timeout(600)], id="twelve times"),
        ],
    )
    def test_a_hub_that_hangs_costs_no_robot_a_will(self, mesh: Mesh, hangs: int) -> None:
        for name in NAMES:
            mesh.robots(name, *(f"{name}{robot}" for robot in range(3)))
        for number in range(hangs):
            name = NAMES[number % 3]
            watch = Watch(mesh, NAMES.replace(name, ""))
            watch.begin()
            mesh.hubs[name].signal(signal.SIGSTOP)
            began = time.monotonic()
            time.sleep(3)
            assert watch.receives(*(f"{one}{robot}" for one in NAMES for robot in range(3))), "at another hub"
            time.sleep(max(0.0, began + 6 - time.monotonic()))
            mesh.hubs[name].signal(signal.SIGCONT)
            time.sleep(QUIET_S)
            assert watch.saw({}), (number, watch.seen)


@pytest.mark.alone
@pytest.mark.parametrize(
    "rounds",
    [
        pytest.param(1, id="once"),
        pytest.param(10, marks=[pytest.mark.thorough, pytest.mark.timeout(900)], id="ten times"),
    ],
)
def test_after_a_separation_the_newest_of_both_sides_counts_everywhere(mesh: Mesh, rounds: int) -> None:
    for number in range(rounds):
        _separate(mesh, f"r{number}", restart=number % 2 == 1)


def _separate(mesh: Mesh, base: str, *, restart: bool) -> None:
    def publish(client: Transport, name: str, payload: bytes) -> None:
        assert client.publish(f"{base}/{name}", payload, qos=QoS.DELIVERED, retain=True)

    writer, far_writer = mesh.client(f"writer-{base}", "a"), mesh.client(f"far-writer-{base}", "c")
    running: dict[str, dict[str, bytes]] = {}
    history: list[tuple[str, str, bytes]] = []

    def take(hub: str) -> Callable[[Message], None]:
        def taken(message: Message) -> None:
            running[hub][message.topic.rpartition("/")[2]] = message.payload
            history.append((hub, message.topic.rpartition("/")[2], message.payload))

        return taken

    for hub in "ac":
        running[hub] = {}
        mesh.client(f"subscriber-{hub}-{base}", hub).subscribe(f"{base}/#", take(hub))
    for name in ("near", "far", "near-then-far", "far-then-near", "gone-near", "gone-far", "untouched", "alive"):
        publish(writer, name, b"before")
    assert until(lambda: len(running["c"]) == 8)
    for link in mesh.links:
        link.blackhole()
    assert until(lambda: not _sees_another(mesh, "c"), 15)
    near, far = mesh.client(f"near-{base}", "a"), mesh.client(f"far-{base}", "c")
    for client, name, payload in (
        (near, "near", b"new"),
        (near, "large", LARGE),
        (far, "larger", 2 * LARGE),
        (far, "far", b"new"),
        (near, "near-then-far", b"older"),
        (far, "far-then-near", b"older"),
        (near, "gone-near", b""),
        (far, "gone-far", b""),
        (near, "new-near", b"1"),
        (far, "new-far", b"1"),
        (writer, "alive", b"said by itself"),
    ):
        publish(client, name, payload)
    time.sleep(1)
    publish(far, "near-then-far", b"newest")
    publish(near, "far-then-near", b"newest")
    near.close()
    far.close()
    if restart:
        mesh.hubs["b"].kill()
        mesh.start("b")
    history.clear()
    for link in mesh.links:
        link.resume()
    new = {
        "large": LARGE,
        "larger": 2 * LARGE,
        "near": b"new",
        "far": b"new",
        "new-near": b"1",
        "new-far": b"1",
        "alive": b"said by itself",
    }
    expected = new | {"near-then-far": b"newest", "far-then-near": b"newest", "untouched": b"before"}
    assert until(lambda: _sees_another(mesh, "c"), 15)
    assert until(lambda: all(expected.items() <= found.items() for found in running.values())), running
    for hub in NAMES:
        assert until(lambda hub=hub: mesh.retained(hub, f"{base}/#") == expected), (
            hub,
            mesh.retained(hub, f"{base}/#"),
        )
    for hub in "ac":
        for name in ("near-then-far", "far-then-near"):
            seen = [payload for at, one, payload in history if (at, one) == (hub, name)]
            assert seen == sorted(seen, key=(b"before", b"older", b"newest").index), (hub, name, seen)
    for client in (writer, far_writer):
        client.close()


def _sees_another(mesh: Mesh, hub: str) -> bool:
    """Whether a client of ``hub`` sees a second hub."""
    with create("zenoh", "looks", replace(mesh.hubs[hub].settings, client=True, listen=(), journal=None)) as client:
        session = client.session  # type: ignore[attr-defined]
        return len(list(session.liveliness().get(f"{wire.UP}*", timeout=1.0))) > 1
