"""Real sockets and a real broker: whatever arrives or fails, motors are off in time and heartbeats go on."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pytest

from pebble.extensions.lab.simulation.wireless import KINDS
from tests.firmware.test_deadman_virtual import HOSTILE
from tests.firmware.wireless_rig import Robots
from tests.robot.operator import Operator
from tests.support import Broker, until
from tests.tcp_proxy import TcpProxy

HUGE = (b'{"x": 0, "z": 1, "pad": "' + b"x" * 100_000 + b'"}', b"[" * 100_000, b'{"z": 1' + b"0" * 900 + b"}")
LIMIT_S, RATE_HZ, EVERY_S = 1.0, 4.0, 0.05


class Hall:
    """A broker, a link to one robot of each kind, and an operator; while they connect, a command is retained."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.broker = Broker(folder)
        stack.callback(self.broker.kill)
        self.link = stack.enter_context(TcpProxy(self.broker.port))
        self.operator = stack.enter_context(closing(Operator(self.broker.port, "pebble/robots", "+/outgoing/online")))
        self.send(b'{"x": 0, "z": 1}', retain=True)
        self.robots = stack.enter_context(Robots("127.0.0.1", self.link.port))
        self.robots.wait_online()
        assert self.beating(time.monotonic())
        self.have_not_moved()

    def moving(self) -> bool:
        return all(map(self.robots.moving, KINDS))

    def resting(self) -> bool:
        return not any(map(self.robots.moving, KINDS))

    def drive(self, z: float = 0.8) -> float:
        """Return when the broker had it."""
        self.send({"x": 0.0, "z": z})
        return time.monotonic()

    def send(self, body: Any, **options: Any) -> None:
        """Publish a drive command to each robot, and wait until the broker has it."""
        for info in [self.operator.send(f"{kind}/incoming/drive-values", body, **options) for kind in KINDS]:
            info.wait_for_publish(5)

    def heartbeats(self, kind: str, since: float) -> list[dict[str, Any]]:
        beats = [one.json for one in self.operator.on(f"{kind}/outgoing/online", since) if not one.retain]
        return [beat for beat in beats if beat["online"]]

    def beating(self, since: float, count: float = 2.0) -> bool:
        return until(lambda: all(len(self.heartbeats(kind, since)) > count for kind in KINDS))

    def have_not_moved(self) -> None:
        assert [self.robots.moves[kind] for kind in KINDS] == [[], []]


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hall]:
    with ExitStack() as stack:
        yield Hall(tmp_path_factory.mktemp("hall"), stack)


@pytest.fixture
def hall(running: Hall) -> Hall:
    """With robots online, free and at rest."""
    running.robots.wait_online()
    assert until(running.resting)
    for moves in running.robots.moves.values():
        moves.clear()
    return running


def test_nothing_hostile_moves_a_robot_or_stops_its_heartbeat(hall: Hall) -> None:
    began = time.monotonic()
    for number, payload in enumerate((*HOSTILE, *HUGE)):
        hall.send(payload, qos=number % 2)
        time.sleep(EVERY_S)
    assert hall.beating(began, 2.5 * RATE_HZ)
    hall.have_not_moved()
    for kind in KINDS:
        stamps = [beat["t"] for beat in hall.heartbeats(kind, began)]
        assert (len(stamps) - 1) / (stamps[-1] - stamps[0]) * 1000 == pytest.approx(RATE_HZ, rel=0.1)
        assert hall.robots.robots[kind].online
    hall.drive()
    assert until(hall.moving)
    assert hall.robots.alive


@pytest.mark.parametrize("fault", ["black hole", "broker killed"])
def test_motors_are_off_within_a_second_and_no_retained_command_moves_them_afterwards(hall: Hall, fault: str) -> None:
    begin, end = {
        "black hole": (hall.link.blackhole, hall.link.resume),
        "broker killed": (hall.broker.kill, hall.broker.start),
    }[fault]
    last = hall.drive()
    assert until(hall.moving)
    begin()
    assert until(hall.resting, 3.0)
    for kind in KINDS:
        assert hall.robots.stopped_at(kind) - last <= LIMIT_S, kind
    assert until(lambda: not any(robot.online for robot in hall.robots.robots.values()))
    end()
    moves = {kind: len(moves) for kind, moves in hall.robots.moves.items()}
    hall.robots.wait_online(20.0)
    assert hall.beating(time.monotonic())
    assert {kind: len(moves) for kind, moves in hall.robots.moves.items()} == moves
    assert until(lambda: hall.drive() and hall.moving(), step=EVERY_S)
    assert hall.robots.alive
