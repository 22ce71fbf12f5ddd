"""Robots with a list of three brokers: killed, hung and cut off ones, while they are driven and stopped."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from pebble.contract.identity import Identity
from pebble.runtime.every_host import EveryHost
from pebble.simulation.fleet import Fleet, members
from pebble.simulation.wireless import BrokerAddress
from pebble.transports import MqttSettings
from tests.fleet.hosts_rig import FAULTS, Counts, Hosts, fail_while_driving, hosts
from tests.robot.rig import BASE
from tests.support import Broker, cases, free_port, further, until
from tests.web.served import Served

pytestmark = pytest.mark.alone
NEVER = ("twice", "out of order", "older than 1 s", "false wills after the robot was heard elsewhere",
         "values older than the newest")  # fmt: skip
#: Seconds until the first heartbeat at another host.
ELSEWHERE_S = {"kill": 1.0, "freeze": 6.0, "part": 6.0, "cut": 1.0, "freeze two": 6.0}


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hosts]:
    with hosts(tmp_path_factory.mktemp("hosts"), 3) as made:
        yield made


@pytest.mark.parametrize("fault", ["kill", *map(further, sorted(FAULTS.keys() - {"kill"}))])
def test_a_driven_robot_goes_to_another_host(world: Hosts, fault: str) -> None:
    counts = Counts()
    for _ in range(cases(1, 6)):
        fail_while_driving(world, fault, counts)
    sys.stdout.write(f"\n{fault}: {counts}\n")
    assert {what: counts.wrong[what] for what in NEVER} == dict.fromkeys(NEVER, 0)
    assert max(counts.took[f"{fault}: heartbeat elsewhere after"]) <= ELSEWHERE_S[fault]
    assert max(counts.took["wheels left turning"]) <= 1.0


@pytest.mark.thorough
def test_so_it_does_over_tls(tmp_path: Path) -> None:
    counts = Counts()
    with hosts(tmp_path, tls=True) as world:
        for fault in ("kill", "freeze", "part", "cut"):
            fail_while_driving(world, fault, counts)
    sys.stdout.write(f"\nTLS: {counts}\n")
    assert {what: counts.wrong[what] for what in NEVER} == dict.fromkeys(NEVER, 0)
    assert max(counts.took["wheels left turning"]) <= 1.0


@pytest.mark.thorough
@pytest.mark.parametrize("fault", FAULTS)
def test_a_stop_while_the_host_changes_takes_effect_once_there_is_one(world: Hosts, fault: str) -> None:
    counts = Counts()
    for _ in range(cases(1, 3)):
        fail_while_driving(world, fault, counts, stops=True)
        world.reset()
    sys.stdout.write(f"\n{fault}, stops: {counts}\n")
    assert {what: counts.wrong[what] for what in NEVER} == dict.fromkeys(NEVER, 0)
    assert max(counts.took["stop confirmed after a host is heard"]) <= 1.0
    assert max(counts.took["wheels left turning"]) <= 1.0


@pytest.mark.thorough
def test_the_page_drives_it_at_the_standby_and_it_returns_once_it_rests(tmp_path: Path) -> None:
    with hosts(tmp_path) as world:
        places = tuple(("127.0.0.1", one.port) for one in world.brokers)
        broker = MqttSettings(host="127.0.0.1", port=places[0][1], hosts=places)
        with Served(places[0][1], broker=broker) as server, server.page(name="ann") as page:
            assert page.knows(BASE)
            assert until(lambda: page.value(BASE, "web/host", "first") is True)
            assert until(lambda: page.ready())
            assert page.take(BASE)
            world.brokers[0].kill()
            assert until(lambda: page.value(BASE, "web/host", "first") is False)
            moved, gesture = time.monotonic(), 0
            while not world.rig.mcu.moving(moved) and time.monotonic() < moved + 10:
                gesture += 1
                for _ in range(4):
                    page.drive(BASE, gesture, z=0.5)
                    time.sleep(0.05)
            driven_s = time.monotonic() - moved
            page.send("estop", ref=BASE, stop="00c0ffee00c0ffee", why="")
            assert until(lambda: page.value(BASE, "web/estop", "latched") is True, 2)
            world.reset()
            world.brokers[0].start()
            back = time.monotonic()
            assert until(lambda: page.value(BASE, "web/host", "first") is True, 140, step=0.1)
            returned_s = time.monotonic() - back
        sys.stdout.write(f"\ndriven {driven_s:.2f} s after the change, returned after {returned_s:.0f} s\n")
        assert driven_s <= 2.0
        assert returned_s <= 130


class Boards:
    """Virtual boards with a list of two hosts, and when their heartbeats came from each."""

    def __init__(self, count: int, brokers: list[Broker]) -> None:
        self._fleet = Fleet(BrokerAddress(host=tuple(one.host for one in brokers), port=brokers[0].port))
        self.bases = [identity.base for kind, identity in members(count) if self._add(kind, identity)]
        places = tuple((one.host, one.port) for one in brokers)
        self.operator = EveryHost("operator", MqttSettings(host=places[0][0], port=places[0][1], hosts=places))
        self.found: dict[str, tuple[float, str]] = {}
        self.operator.moved = lambda base: self.found.update({base: (time.monotonic(), self.operator.host_of(base))})
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._fleet.run, args=(lambda: not self._ending.is_set(),))
        self._thread.start()
        self.operator.open()

    def _add(self, kind: str, identity: Identity) -> bool:
        return bool(self._fleet.add(kind, identity))

    def all_at(self, broker: Broker) -> bool:
        place = f"{broker.host}:{broker.port}"
        return all(self.found.get(base, (0.0, ""))[1] == place for base in self.bases)

    def close(self) -> None:
        self._ending.set()
        self._thread.join(10)
        self._fleet.close()
        self.operator.close()


@pytest.mark.thorough
@pytest.mark.parametrize(("fault", "limit_s"), [("kill", 3.0), ("freeze", 8.0)])
def test_boards_go_to_the_next_host(tmp_path: Path, fault: str, limit_s: float) -> None:
    port = free_port()
    brokers = [Broker(tmp_path / host, port=port, host=host) for host in _folders(tmp_path, "127.0.0.2", "127.0.0.3")]
    boards = Boards(300, brokers)
    try:
        assert until(lambda: boards.all_at(brokers[0]), 180, step=0.2)
        failed = time.monotonic()
        {"kill": brokers[0].kill, "freeze": brokers[0].freeze}[fault]()
        assert until(lambda: boards.all_at(brokers[1]), 60, step=0.1)
        took = sorted(at - failed for at, _ in boards.found.values())
    finally:
        boards.close()
        for one in brokers:
            one.kill()
    p99 = took[int(0.99 * len(took)) - 1]
    sys.stdout.write(
        f"\n{fault}, {len(took)} boards: p50 {took[len(took) // 2]:.2f}, p99 {p99:.2f}, max {took[-1]:.2f} s\n"
    )
    assert p99 <= limit_s


def _folders(folder: Path, *names: str) -> tuple[str, ...]:
    for name in names:
        (folder / name).mkdir()
    return names
