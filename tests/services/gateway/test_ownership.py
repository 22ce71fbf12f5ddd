"""Who carries a robot, in virtual time: gateways that hang, are killed and restart, late messages, silent hubs."""

from __future__ import annotations

import random
from collections import deque
from dataclasses import dataclass, field

import pytest

from pebble.services.gateway.ownership import ALONE_S, FRESH_S, TAKING_S, WILL_S, Ownership
from tests.support import cases

STEP_S, HEARTBEAT_S = 0.02, 0.25
ROBOTS = [f"pebble/robots/r{n}" for n in range(4)]
RECOVERY_S = 2 * TAKING_S + ALONE_S


@dataclass
class Published:
    """What a gateway publishes; ``robots`` None: its will."""

    sender: str
    sent_at: float
    robots: frozenset[str] | None


@dataclass(eq=False)
class Simulated:
    """A gateway with a way to the broker and back; both keep the order and delay what passes."""

    name: str
    ownership: Ownership
    up_s: float = 0.01
    down_s: float = 0.01
    hung: bool = False
    robots: frozenset[str] = frozenset(ROBOTS)
    heartbeat_at: float = 0.0
    up: deque[tuple[float, Published]] = field(default_factory=deque)
    down: deque[tuple[float, Published]] = field(default_factory=deque)


class Broker:
    """Passes heartbeats on in order, and the wills of gateways that are killed."""

    def __init__(self, seed: int, names: list[str]) -> None:
        self.random, self.now = random.Random(seed), 100.0
        self.gateways: dict[str, Simulated] = {}
        self.retained: dict[str, Published] = {}
        self.twice: list[str] = []
        for name in names:
            self.start(name)

    def start(self, name: str) -> None:
        one = self.gateways[name] = Simulated(name, Ownership(name))
        one.ownership.connected(self.now)
        one.down.extend((self.now, heartbeat) for heartbeat in self.retained.values())

    def kill(self, name: str) -> None:
        """What it had sent arrives; then the broker publishes its will."""
        one = self.gateways.pop(name)
        for _, heartbeat in one.up:
            self._distribute(heartbeat)
        self._distribute(Published(name, self.now, None))

    def run(self, seconds: float) -> None:
        end = self.now + seconds
        while self.now < end:
            self.now += STEP_S
            self._step()

    def holders(self, robot: str) -> list[str]:
        return [
            one.name
            for one in self.gateways.values()
            if not one.hung and one.ownership.since(robot, self.now) is not None
        ]

    def _step(self) -> None:
        for one in self.random.sample(sorted(self.gateways.values(), key=lambda each: each.name), len(self.gateways)):
            while one.up and one.up[0][0] + one.up_s <= self.now:
                self._distribute(one.up.popleft()[1])
            if one.hung:
                continue
            for robot in ROBOTS:  # what waits at it is judged first: as when it wakes up with commands in its socket
                one.ownership.since(robot, self.now)
            while one.down and one.down[0][0] + one.down_s <= self.now:
                self._receive(one, one.down.popleft()[1])
            if self.now - one.heartbeat_at >= HEARTBEAT_S:
                one.heartbeat_at = self.now
                one.up.append((self.now, Published(one.name, self.now, one.robots)))
            one.ownership.judge(self.now)
        self.twice += [f"{self.now:.2f} {robot}: {who}" for robot in ROBOTS if len(who := self.holders(robot)) > 1]

    def _distribute(self, heartbeat: Published) -> None:
        if heartbeat.robots is None:
            self.retained.pop(heartbeat.sender, None)
        else:
            self.retained[heartbeat.sender] = heartbeat
        for one in self.gateways.values():
            one.down.append((self.now, heartbeat))

    def _receive(self, one: Simulated, heartbeat: Published) -> None:
        if heartbeat.sender == one.name:
            if heartbeat.robots is not None:
                one.ownership.came_back(heartbeat.sent_at, heartbeat.robots, self.now)
        elif heartbeat.robots is None:
            one.ownership.left(heartbeat.sender, self.now)
        else:
            one.ownership.received(heartbeat.sender, heartbeat.robots, self.now)


def test_one_alone_carries_all() -> None:
    broker = Broker(1, ["a"])
    broker.run(TAKING_S + HEARTBEAT_S)
    assert [broker.holders(robot) for robot in ROBOTS] == [["a"]] * len(ROBOTS)


def test_two_share_and_each_robot_has_one() -> None:
    broker = Broker(1, ["a", "b"])
    broker.run(4)
    assert sorted(name for robot in ROBOTS for name in broker.holders(robot)) == ["a", "a", "b", "b"]


@pytest.mark.parametrize(
    ("fault", "most_s"),
    [("kill", WILL_S), ("hang", FRESH_S + TAKING_S), ("deaf", TAKING_S + HEARTBEAT_S), ("start", TAKING_S)],
)
def test_a_robot_has_another_gateway_soon(fault: str, most_s: float) -> None:
    broker = Broker(1, ["a", "b"])
    broker.run(4)
    if fault == "kill":
        broker.kill("a")
    elif fault == "start":
        broker.kill("a")
        broker.run(4)
        broker.start("a")
        broker.run(HEARTBEAT_S)
    elif fault == "hang":
        broker.gateways["a"].hung = True
    else:
        broker.gateways["a"].robots = frozenset()
    broker.run(most_s + 0.1)
    assert all(len(broker.holders(robot)) == 1 for robot in ROBOTS)
    assert broker.twice == []


def test_one_that_hung_forwards_nothing_when_it_goes_on() -> None:
    broker = Broker(1, ["a", "b"])
    broker.run(4)
    broker.gateways["a"].hung = True
    broker.run(6)
    broker.gateways["a"].hung = False
    assert [robot for robot in ROBOTS if broker.gateways["a"].ownership.since(robot, broker.now)] == []
    broker.run(4)
    assert broker.twice == []
    assert sorted({name for robot in ROBOTS for name in broker.holders(robot)}) == ["a", "b"]


@pytest.mark.parametrize("seed", range(cases(20, 1000)))
def test_no_robot_has_two_whatever_fails(seed: int) -> None:
    names = ["a", "b", "c"][: 2 + seed % 2]
    broker = Broker(seed, names)
    chance = broker.random
    for _ in range(40):
        broker.run(chance.choice((0.1, 0.3, 1.0, 1.5, 3.0)))
        name = chance.choice(names)
        one = broker.gateways.get(name)
        match chance.randrange(6):
            case _ if one is None:
                broker.start(name)
            case 0:
                broker.kill(name)
            case 1:
                one.hung = not one.hung
            case 2:
                one.robots = frozenset(robot for robot in ROBOTS if chance.random() < 0.7)
            case _:
                one.up_s, one.down_s = (chance.choice((0.0, 0.02, 0.2, 0.45, 0.7, 1.1, 3.0)) for _ in range(2))
        assert broker.twice == []
    for name in names:
        if name not in broker.gateways:
            broker.start(name)
    for one in broker.gateways.values():
        one.up_s = one.down_s = 0.01
        one.hung, one.robots = False, frozenset(ROBOTS)
    broker.run(RECOVERY_S)
    assert broker.twice == []
    assert all(len(broker.holders(robot)) == 1 for robot in ROBOTS)
