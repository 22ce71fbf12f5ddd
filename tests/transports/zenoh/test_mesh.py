"""Three linked hubs as processes: each will once, hubs that hang or are killed, and a separation that heals.

One of each in the normal run; `make long PART=fleet` has the series (`PEBBLE_THOROUGH=1`).
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

from pebble.client.hubs import hub_states
from pebble.fleet import applying, certificates
from pebble.fleet.folder import ZENOH, Fleet
from pebble.fleet.roles import Account
from pebble.transports import Message, QoS, State, Transport, ZenohSettings, create
from pebble.transports.zenoh import wire
from pebble.transports.zenoh.hub.links import CUT_S
from tests.support import ROOT, free_port, until
from tests.tcp_proxy import TcpProxy
from tests.transports.forked import Forked
from tests.transports.zenoh.mesh_robots import HEARTBEAT, WILL, certificate_of, settings_of

NAMES = "abc"
EYE = "eye"  # the account of all clients that are no robots
KILLS = ("robot", "hub", "both")
LARGE = bytes(200_000)  # more than one message between two hubs
#: Longer than any hub waits with a will, and what is due then takes a moment.
QUIET_S = 8.0


class Hub:
    """`python -m pebble.runtime.hub` with a journal, on a port of its own.

    ``fleet``: the folder of one with an account of that name. ``clock``: the environment of a machine with another one.
    """

    def __init__(self, folder: Path, name: str, fleet: Path | None, clock: dict[str, str]) -> None:
        self.port = free_port()
        self.place = f"{'tls' if fleet else 'tcp'}/127.0.0.1:{{}}"
        self.endpoint = self.place.format(self.port)
        self.settings = ZenohSettings(
            run_dir=folder / name,
            listen=(self.endpoint,),
            journal=folder / f"{name}.journal",
            tls=certificate_of(fleet, name) if fleet else None,
            access=fleet / ZENOH if fleet else None,
        )
        self._clock = clock
        self._process: Forked | subprocess.Popen[bytes] | None = None

    def start(self, others: list[str]) -> None:
        settings = msgspec.json.encode(replace(self.settings, connect=tuple(others)), enc_hook=str).decode()
        if self._clock:
            command = [sys.executable, "-m", "pebble.runtime.hub", settings]
            self._process = subprocess.Popen(command, env=os.environ | self._clock)
        else:
            self._process = Forked("pebble.runtime.hub", [settings])

    def kill(self) -> None:
        if self._process is not None:
            process, self._process = self._process, None
            os.kill(process.pid, signal.SIGCONT)
            process.kill()
            process.wait(10)

    def signal(self, number: int) -> None:
        assert self._process is not None
        os.kill(self._process.pid, number)

    @property
    def state(self) -> tuple[int | None, str]:
        """Its exit code, None while it runs, and what it has written."""
        return (None, "") if self._process is None else (self._process.poll(), getattr(self._process, "printed", ""))


class Listener:
    """A client of one hub that counts wills and heartbeats, by robot."""

    def __init__(self, mesh: Mesh, hub: str) -> None:
        self.wills: Counter[str] = Counter()
        self.expected: Counter[str] = Counter()
        self.seen: list[tuple[float, str, bool]] = []
        self.heartbeats: dict[str, int] = {}
        self.gaps: dict[str, float] = {}  # between two heartbeats, the longest
        self._last: dict[str, float] = {}
        self.client = mesh.client(f"listener-{hub}", [hub])
        self.client.subscribe(HEARTBEAT.format("+"), self._take)

    def _take(self, message: Message) -> None:
        robot = message.topic.split("/")[2]
        if message.payload == WILL:
            self.seen.append((time.monotonic(), robot, message.retain))
            self.wills[robot] += not message.retain  # a copy of it comes as often as a hub does
        else:
            now = time.monotonic()
            self.heartbeats[robot] = self.heartbeats.get(robot, 0) + 1
            self.gaps[robot] = max(self.gaps.get(robot, 0.0), now - self._last.get(robot, now))
            self._last[robot] = now


class Mesh:
    """Hubs, each linked to the others; the last one through proxies, which can be cut.

    ``fleet``: the folder of one, with accounts for all; else there is no TLS. ``clock``: of the last one's machine.
    """

    def __init__(self, folder: Path, fleet: Path | None = None, clock: dict[str, str] | None = None) -> None:
        self.folder, self._fleet = folder, fleet
        self.hubs = {name: Hub(folder, name, fleet, (clock or {}) if name == NAMES[-1] else {}) for name in NAMES}
        self.links = [TcpProxy(self.hubs[name].port) for name in NAMES[:-1]]
        self._clients: list[Transport] = []
        self._robots: dict[str, Forked] = {}
        for name in NAMES:
            self.start(name)

    def start(self, name: str) -> None:
        if name == NAMES[-1]:
            others = [self.hubs[name].place.format(link.port) for link in self.links]
        else:
            others = [hub.endpoint for other, hub in self.hubs.items() if other not in (name, NAMES[-1])]
        self.hubs[name].start(others)
        probe = self.client("probe", [name])
        probe.close()

    def client(self, name: str, hubs: str | list[str], *, will: Message | None = None) -> Transport:
        connect = tuple(self.hubs[one].endpoint for one in hubs)
        settings = settings_of(self.folder / "clients", connect, EYE, self._fleet)
        client = create("zenoh", name, settings, will=will).open(20)
        connected = until(lambda: client.state is State.CONNECTED, 30)
        assert connected, (client.problem, {one: self.hubs[one].state for one in hubs})
        self._clients.append(client)
        return client

    def robots(self, home: str, *names: str) -> float:
        """A process of robots that connect to ``home`` first; returns the seconds until the slowest was open."""
        order = [home, *NAMES.replace(home, "")]
        endpoints = ",".join(self.hubs[one].endpoint for one in order)
        process = Forked("tests.transports.zenoh.mesh_robots", endpoints, ",".join(names), str(self._fleet or ""))
        slowest = float(process.stdout.readline())
        self._robots |= dict.fromkeys(names, process)
        return slowest

    def is_whole(self) -> bool:
        """Whether each hub has a connection to each other one, and sees it: after one hung that takes a while."""
        states = hub_states(self.hubs[NAMES[0]].settings)
        return [(one.links, len(one.hubs)) for one in states] == [(len(NAMES) - 1, len(NAMES) - 1)] * len(NAMES)

    def kill_robot(self, name: str) -> None:
        process = self._robots.pop(name)
        process.kill()
        process.wait(10)

    def wrong(self, hub: str, filter_: str, expected: dict[str, bytes]) -> dict[str, bytes]:
        """What a client that comes late is told and should not be, or not told and should be, by the last level."""
        found: dict[str, bytes] = {}
        with create("zenoh", "late", replace(self.hubs[hub].settings, client=True, listen=(), journal=None)) as late:
            assert until(lambda: late.state is State.CONNECTED), late.problem
            late.subscribe(filter_, lambda message: found.update({message.topic.rpartition("/")[2]: message.payload}))
            until(lambda: found == expected, 3)  # every hub answers, and megabytes take their time
        return {key: found.get(key, b"-")[:20] for key, _ in found.items() ^ expected.items()}

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
    """A listener at each of several hubs, and the wills that each has to see from when it came."""

    def __init__(self, mesh: Mesh, hubs: str = NAMES) -> None:
        self._mesh = mesh
        self._began = time.monotonic()
        self._listeners = {hub: Listener(mesh, hub) for hub in hubs}

    def leave(self, hub: str) -> None:
        self._listeners.pop(hub).client.close()

    def enter(self, hub: str) -> None:
        self._listeners[hub] = Listener(self._mesh, hub)

    def expect(self, robot: str) -> None:
        for listener in self._listeners.values():
            listener.expected[robot] += 1

    def saw(self, limit_s: float = QUIET_S) -> bool:
        """Whether every listener has seen exactly what it should, or will soon."""
        return until(lambda: all(one.wills == one.expected for one in self._listeners.values()), limit_s)

    def latest(self, robot: str) -> float:
        """When the last of them saw the newest will of ``robot``."""
        return max(
            next(at for at, one, copy in reversed(listener.seen) if one == robot and not copy)
            for listener in self._listeners.values()
        )

    def begin_gaps(self) -> None:
        for listener in self._listeners.values():
            listener.gaps.clear()

    def gaps(self, robots: Collection[str]) -> list[float]:
        return [listener.gaps[robot] for listener in self._listeners.values() for robot in robots]

    def __str__(self) -> str:
        return json.dumps(
            {
                hub: {
                    "expected": one.expected,
                    "seen": [(round(at - self._began, 2), robot, copy) for at, robot, copy in one.seen[-20:]],
                    "now": round(time.monotonic() - self._began, 2),
                }
                for hub, one in self._listeners.items()
            }
        )

    def receives(self, *robots: str) -> bool:
        """Whether everyone has a new heartbeat of each soon."""
        for listener in self._listeners.values():
            listener.heartbeats.clear()
        return until(
            lambda: all(set(robots) <= listener.heartbeats.keys() for listener in self._listeners.values()), 15
        )


def fleet_of(folder: Path, *robots: str) -> Path:
    """A folder of `pebble fleet` with the hubs, these robots and a viewer."""
    accounts = {name: Account(roles=("hub",)) for name in NAMES} | {EYE: Account(roles=("viewer",))}
    accounts |= {name: Account(roles=("robot",), bases=(f"pebble/robots/{name}",)) for name in robots}
    certificates.init(folder, ["127.0.0.1"])
    for name in accounts:
        certificates.of_account(folder, name, ["127.0.0.1"] if name in NAMES else ())
    applying.write_zenoh(folder, Fleet(level="named", brokers=(), hubs="here", accounts=accounts))
    return folder


@pytest.fixture
def mesh(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Mesh]:
    made = Mesh(tmp_path, **{what: make(tmp_path) for what, make in getattr(request, "param", {}).items()})
    try:
        yield made
    finally:
        made.stop()


def the_fleet(folder: Path) -> Path:
    return fleet_of(folder / "hall", *(f"{name}{one}" for name in NAMES for one in (0, 1, "-more0", "-more1")))


def an_hour_ahead(folder: Path) -> dict[str, str]:
    """The environment in which the clock of the day, and that since the start, are an hour ahead of this machine's."""
    library = folder / "ahead.so"
    subprocess.run(
        ["cc", "-shared", "-fPIC", "-O", "-o", library, ROOT / "tests/kit/clock_ahead.c", "-ldl"], check=True
    )
    return {"LD_PRELOAD": str(library), "CLOCK_AHEAD_S": "3600"}


class TestWills:
    @pytest.mark.alone
    @pytest.mark.parametrize(
        ("mesh", "others", "kills"),
        [
            pytest.param({}, 2, KILLS, id="one of each"),
            pytest.param({}, 15, KILLS * 20, id="sixty", marks=[pytest.mark.thorough, pytest.mark.timeout(1800)]),
            pytest.param({"fleet": the_fleet}, 2, KILLS * 4, id="tls and accounts", marks=pytest.mark.thorough),
        ],
        indirect=["mesh"],
    )
    def test_each_is_published_once_and_none_of_a_robot_that_runs(
        self, mesh: Mesh, others: int, kills: tuple[str, ...]
    ) -> None:
        """A hub is back while others still wait for what it may have left, and so is a robot."""
        chosen = random.Random(4)
        running = {name: [f"{name}{number}" for number in range(2)] for name in NAMES}
        took: dict[str, list[float]] = {"robot": [], "both": [], "hub": []}
        for name in NAMES:
            mesh.robots(name, *(f"{name}-more{number}" for number in range(others)))
            for robot in running[name]:
                mesh.robots(name, robot)
        watch = Watch(mesh)
        everyone = [robot for robots in running.values() for robot in robots]
        assert watch.receives(*everyone)
        for number, kill in enumerate(kills):
            name = NAMES[number % 3]
            robot = chosen.choice(running[name])
            if kill != "robot":
                watch.leave(name)
            at = time.monotonic()
            _kill(mesh, kill, name, robot, watch)
            if kill == "hub":
                assert watch.receives(*everyone), (number, robot)
                took[kill].append(time.monotonic() - at)
            assert watch.saw(), f"{number} {kill} {robot}: {watch}"
            if kill != "hub":
                took[kill].append(watch.latest(robot) - at)
            if kill != "robot":
                time.sleep(chosen.uniform(0, 3))
                mesh.start(name)
            if kill != "hub":
                mesh.robots(name, robot)
            if kill != "robot":
                watch.enter(name)
            assert watch.receives(robot), (number, kill, robot)
        time.sleep(QUIET_S)  # nor does a hub that came back publish one again
        assert watch.saw(), str(watch)
        sys.stdout.write(f"\nuntil a will, and with a killed hub until all are heard: {_figures(took)}\n")
        assert max(took["robot"]) <= 1.0
        assert max(took["both"]) <= 5.0

    @pytest.mark.alone
    @pytest.mark.thorough
    def test_a_hub_that_comes_back_publishes_none_that_others_have(self, mesh: Mesh) -> None:
        """Its robot is back long before the hubs have compared what they have."""
        mesh.robots("c", "c0")
        watch = Watch(mesh)
        assert watch.receives("c0")
        watch.leave("c")
        _kill(mesh, "both", "c", "c0", watch)
        assert watch.saw(), str(watch)
        for link in mesh.links:
            link.blackhole()
        mesh.start("c")
        watch.enter("c")
        mesh.robots("c", "c0")
        time.sleep(QUIET_S)
        for link in mesh.links:
            link.resume()
        assert watch.receives("c0")
        time.sleep(QUIET_S)
        assert watch.saw(), str(watch)

    @pytest.mark.alone
    @pytest.mark.thorough
    def test_a_hub_that_makes_its_socket_anew_loses_none(self, mesh: Mesh) -> None:
        """Its session is closed while a will is due, as with a renewed certificate."""
        assert until(mesh.is_whole)
        mesh.robots("a", "a0")
        mesh.robots("a", "a1")
        watch = Watch(mesh, "bc")
        assert watch.receives("a0", "a1")
        (mesh.hubs["a"].settings.run_dir / "hub.sock").unlink()
        time.sleep(0.8)  # it looks each second
        mesh.kill_robot("a0")
        watch.expect("a0")
        time.sleep(QUIET_S)
        assert watch.saw(), str(watch)
        assert watch.receives("a1")

    @pytest.mark.alone
    @pytest.mark.thorough
    @pytest.mark.parametrize("name", NAMES)
    def test_a_hub_that_makes_its_socket_anew_is_seen_and_sees(self, mesh: Mesh, name: str) -> None:
        """Sooner than a hub that is blind makes its connections anew once more."""
        for number in range(5):
            assert until(mesh.is_whole), number
            socket = mesh.hubs[name].settings.run_dir / "hub.sock"
            socket.unlink()
            assert until(socket.exists, 5)
            assert until(mesh.is_whole, CUT_S), number

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
        took: dict[str, list[float]] = {"hung": [], "whole": []}
        robots = [f"{one}{robot}" for one in NAMES for robot in range(3)]
        watch = Watch(mesh)
        assert watch.receives(*robots)
        for number in range(hangs):
            name = NAMES[number % 3]
            watch.leave(name)
            mesh.hubs[name].signal(signal.SIGSTOP)
            began = time.monotonic()
            time.sleep(0.5)  # what it had passed on is not new
            assert watch.receives(*robots), "at another hub"
            took["hung"].append(time.monotonic() - began)
            time.sleep(max(0.0, began + 6 - time.monotonic()))
            mesh.hubs[name].signal(signal.SIGCONT)
            began = time.monotonic()
            assert until(mesh.is_whole, 30), "else the next one is all that connects the others"
            took["whole"].append(time.monotonic() - began)
            assert watch.saw(), (number, str(watch))
            watch.enter(name)
            assert watch.receives(*robots)
        time.sleep(QUIET_S)
        assert watch.saw(), str(watch)
        assert mesh.is_whole()
        sys.stdout.write(f"\nuntil robots are heard elsewhere, and hubs see each other: {_figures(took)}\n")
        assert max(took["hung"]) <= 4.5


@pytest.mark.alone
@pytest.mark.thorough
class TestMany:
    def test_a_killed_hub_leaves_a_gap_that_is_short(self, mesh: Mesh) -> None:
        groups = {name: [f"{name}{number}" for number in range(17)] for name in NAMES}
        for name, group in groups.items():
            mesh.robots(name, *group)
        watch, gaps = Watch(mesh), []
        for turn in range(6):
            name = NAMES[turn % 3]
            mesh.kill_robot(groups[name][0])
            mesh.robots(name, *groups[name])
            assert watch.receives(*groups[name])
            watch.leave(name)
            watch.begin_gaps()
            mesh.hubs[name].kill()
            time.sleep(2)
            gaps += watch.gaps(groups[name])
            mesh.start(name)
            watch.enter(name)
        gaps.sort()
        p99 = gaps[int(0.99 * len(gaps)) - 1]
        sys.stdout.write(f"\n{_figures({'gap': gaps})}, p99 {p99:.3f} s\n")
        assert p99 <= 0.3

    def test_a_message_takes_little_longer_across_hubs(self, mesh: Mesh) -> None:
        took: dict[str, list[float]] = {"a": [], "b": []}
        sender = mesh.client("sender", "a")
        for hub, each in took.items():

            def take(message: Message, each: list[float] = each) -> None:
                each.append(time.monotonic() - float(message.payload))

            mesh.client(f"receiver-{hub}", hub).subscribe("latency", take, direct=True)
        for _ in range(500):
            sender.publish("latency", str(time.monotonic()).encode(), qos=QoS.DELIVERED)
            time.sleep(0.005)
        assert until(lambda: all(len(each) == 500 for each in took.values()))
        middle = {hub: sorted(each)[250] for hub, each in took.items()}
        sys.stdout.write(f"\np50 at the same hub {1e3 * middle['a']:.2f} ms, at another {1e3 * middle['b']:.2f} ms\n")
        assert middle["b"] <= 2 * middle["a"]

    @pytest.mark.parametrize("hubs", ["a", NAMES])
    def test_two_hundred_robots_open(self, mesh: Mesh, hubs: str) -> None:
        slowest = [
            mesh.robots(hubs[group % len(hubs)], *(f"{group}-{number}" for number in range(20))) for group in range(10)
        ]
        sys.stdout.write(f"\n200 robots at {len(hubs)} hub(s): slowest to open {max(slowest):.2f} s\n")
        assert max(slowest) <= 3.0


def _kill(mesh: Mesh, kill: str, name: str, robot: str, watch: Watch) -> None:
    if kill != "robot":
        mesh.hubs[name].kill()
    if kill != "hub":
        mesh.kill_robot(robot)
        watch.expect(robot)


def _figures(took: dict[str, list[float]]) -> str:
    """The median and the largest of each kind, in seconds."""
    each = {kind: sorted(seconds) for kind, seconds in took.items() if seconds}
    return ", ".join(f"{kind} {one[len(one) // 2]:.2f} (max {one[-1]:.2f}, {len(one)})" for kind, one in each.items())


@pytest.mark.alone
@pytest.mark.parametrize(
    ("mesh", "rounds"),
    [
        pytest.param({}, 1, id="once"),
        pytest.param({}, 10, marks=[pytest.mark.thorough, pytest.mark.timeout(900)], id="ten times"),
        pytest.param({"clock": an_hour_ahead}, 2, marks=pytest.mark.thorough, id="clocks an hour apart"),
    ],
    indirect=["mesh"],
)
def test_after_a_separation_the_newest_of_both_sides_counts_everywhere(mesh: Mesh, rounds: int) -> None:
    for number in range(rounds):
        _separate(mesh, f"r{number}", restart=number % 2 == 1)


def _separate(mesh: Mesh, base: str, *, restart: bool) -> None:
    def publish(client: Transport, name: str, payload: bytes) -> None:
        assert client.publish(f"{base}/{name}", payload, qos=QoS.DELIVERED, retain=True)

    writer, far_writer = mesh.client(f"writer-{base}", "a"), mesh.client(f"far-writer-{base}", "c")
    running: dict[str, dict[str, bytes]] = {}
    subscribers: list[Transport] = []
    history: list[tuple[str, str, bytes]] = []

    def take(hub: str) -> Callable[[Message], None]:
        def taken(message: Message) -> None:
            running[hub][message.topic.rpartition("/")[2]] = message.payload
            history.append((hub, message.topic.rpartition("/")[2], message.payload))

        return taken

    for hub in "ac":
        running[hub] = {}
        subscribers.append(mesh.client(f"subscriber-{hub}-{base}", hub))
        subscribers[-1].subscribe(f"{base}/#", take(hub))
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
    healed = time.monotonic()
    assert until(lambda: all(expected.items() <= found.items() for found in running.values())), {
        hub: [key for key, _ in expected.items() - found.items()] for hub, found in running.items()
    }
    sys.stdout.write(f"\n{base}: running clients have all after {time.monotonic() - healed:.2f} s\n")
    for hub in NAMES:
        right = until(lambda hub=hub: not mesh.wrong(hub, f"{base}/#", expected))
        assert right, (base, hub, mesh.wrong(hub, f"{base}/#", expected))
    for hub in "ac":
        for name in ("near-then-far", "far-then-near"):
            seen = [payload for at, one, payload in history if (at, one) == (hub, name)]
            assert seen == sorted(seen, key=(b"before", b"older", b"newest").index), (hub, name, seen)
    for client in (writer, far_writer, *subscribers):
        client.close()


def _sees_another(mesh: Mesh, hub: str) -> bool:
    """Whether a client of ``hub`` sees a second hub."""
    with create("zenoh", "looks", replace(mesh.hubs[hub].settings, client=True, listen=(), journal=None)) as client:
        session = client.session  # type: ignore[attr-defined]
        return len(list(session.liveliness().get(f"{wire.UP}*", timeout=1.0))) > 1
