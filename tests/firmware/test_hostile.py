"""What a robot must not do for whatever arrives on its topics: move, crash, or let its heartbeat stop."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator

import pytest

from pebble.extensions.lab.simulation.wireless import KINDS
from tests.firmware.schedules import HOSTILE
from tests.firmware.wireless_rig import Operator, Robots
from tests.support import Broker, until

HUGE = (
    b'{"x": 0, "z": 1, "pad": "' + b"x" * 100_000 + b'"}',
    b"[" * 100_000,
    b'{"z": 0.' + b"9" * 900 + b"e400}",
    b'{"z": 1' + b"0" * 900 + b"}",
    b'{"z": "0x1"}',
    b'{"z": "1_0"}',
    b'{"value": {"z": {"value": 1}}}',
    b'{"value": {"x": 0, "z": NaN}}',
    b'\xef\xbb\xbf{"z": 1',
    b"\x00" * 1000,
)
RATE_HZ, EVERY_S = 4.0, 0.05


@pytest.fixture(scope="module")
def broker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Broker]:
    broker = Broker(tmp_path_factory.mktemp("broker"))
    yield broker
    broker.kill()


@pytest.fixture(scope="module")
def operator(broker: Broker) -> Iterator[Operator]:
    with Operator(broker.port) as operator:
        yield operator


@pytest.fixture(scope="module")
def running(broker: Broker, operator: Operator) -> Iterator[Robots]:
    """While they connect for the first time there is a retained command."""
    for kind in KINDS:
        info = operator.send(kind, b'{"x": 0, "z": 1}', retain=True)
        assert info is not None
        info.wait_for_publish(5)
    with Robots("127.0.0.1", broker.port) as robots:
        robots.wait_online()
        assert beating_again(operator, time.monotonic())
        assert [robots.moves[kind] for kind in KINDS] == [[], []]
        yield robots


@pytest.fixture
def robots(running: Robots) -> Robots:
    """Online, free and at rest."""
    running.wait_online()
    assert until(lambda: not any(map(running.moving, KINDS)))
    for moves in running.moves.values():
        moves.clear()
    return running


def beating_again(operator: Operator, since: float, count: float = 2.0) -> bool:
    return until(lambda: all(operator.beating(kind, since) > count for kind in KINDS))


def reset(robots: Robots, operator: Operator) -> None:
    for kind, robot in robots.robots.items():
        latch = robot.firmware.stops.latch
        operator.send(kind, json.dumps({"boot": latch.boot, "count": latch.count}), metric="estop-reset")
    assert until(lambda: not any(robot.firmware.stops.latch.latched for robot in robots.robots.values()))


def test_a_retained_command_moves_no_robot_that_connects_or_reconnects(robots: Robots, operator: Operator) -> None:
    for robot in robots.robots.values():
        robot.network.radio.lose()
    assert until(lambda: not any(robot.online for robot in robots.robots.values()))
    for robot in robots.robots.values():
        robot.network.radio.restore()
    robots.wait_online()
    assert beating_again(operator, time.monotonic())
    assert [robots.moves[kind] for kind in KINDS] == [[], []]
    assert all(robot.refused >= 2 for robot in robots.firmware())


def test_nothing_hostile_moves_a_robot_or_stops_its_heartbeat(robots: Robots, operator: Operator) -> None:
    began = time.monotonic()
    for number, payload in enumerate((*HOSTILE, *HUGE)):
        for kind in KINDS:
            operator.send(kind, payload, qos=number % 2)
        time.sleep(EVERY_S)
    assert beating_again(operator, began, 2.5 * RATE_HZ)
    for kind in KINDS:
        assert robots.moves[kind] == []
        stamps = [body["t"] for at, body in operator.heartbeats[kind] if at > began]
        assert (len(stamps) - 1) / (stamps[-1] - stamps[0]) * 1000 == pytest.approx(RATE_HZ, rel=0.1)
        assert robots.robots[kind].online
        operator.drive(kind, 0.0, 0.8)
    assert until(lambda: all(map(robots.moving, KINDS)))
    assert until(lambda: not any(map(robots.moving, KINDS)))
    assert robots.alive


def test_nothing_hostile_on_the_topics_of_stops_frees_a_robot_or_stops_its_heartbeat(
    robots: Robots, operator: Operator
) -> None:
    """What cannot be read stops it, and it is reset and driven afterwards."""
    began = time.monotonic()
    for number, payload in enumerate((*HOSTILE, *HUGE)):
        for kind in KINDS:
            for metric in ("estop", "estop-reset"):
                operator.send(kind, payload, qos=number % 2, metric=metric)
        time.sleep(EVERY_S)
    assert beating_again(operator, began, 2.5 * RATE_HZ)
    for kind, robot in robots.robots.items():
        latch = robot.firmware.stops.latch
        assert latch.latched
        assert latch.count >= len((*HOSTILE, *HUGE)) - 1  # an empty one is none
        operator.drive(kind, 0.0, 0.8)
    reset(robots, operator)
    assert [robots.moves[kind] for kind in KINDS] == [[], []]
    for kind in KINDS:
        operator.drive(kind, 0.0, 0.0)
        operator.drive(kind, 0.0, 0.8)
    assert until(lambda: all(map(robots.moving, KINDS)))
    assert robots.alive


def test_messages_without_end_do_not_keep_the_motors_on(robots: Robots, operator: Operator) -> None:
    """Nonsense at a high rate feeds no dead-man, and a stop is obeyed in the middle of it."""
    for kind in KINDS:
        operator.drive(kind, 0.0, 0.8)
    assert until(lambda: all(map(robots.moving, KINDS)))
    end = time.monotonic() + 1.5
    while time.monotonic() < end:
        for kind in KINDS:
            operator.send(kind, b'{"x": 0, "z": NaN}')
        time.sleep(0.003)
    assert not any(map(robots.moving, KINDS))
    assert robots.alive


def test_a_stop_survives_a_power_cut_on_a_real_broker(robots: Robots, operator: Operator) -> None:
    before = robots.firmware()
    for kind, robot in robots.robots.items():
        operator.send(kind, b'{"stop": "00000000000000aa"}', metric="estop")
        assert until(lambda robot=robot: robot.firmware.stops.latch.latched)  # type: ignore[misc]
        robot.cut_power()
    assert until(lambda: not any(one is other for one, other in zip(before, robots.firmware(), strict=True)))
    robots.wait_online()
    for kind, robot in robots.robots.items():
        assert robot.firmware.stops.latch.latched
        operator.drive(kind, 0.0, 0.8)
    assert beating_again(operator, time.monotonic())
    assert [robots.moves[kind] for kind in KINDS] == [[], []]
