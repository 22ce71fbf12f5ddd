"""What a robot must not do for whatever arrives on its drive topic: move, crash, or let its heart stop."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from pebble.simulation.wireless import KINDS
from tests.firmware.schedules import HOSTILE
from tests.firmware.wireless_rig import Pilot, Robots
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


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    broker = Broker(tmp_path)
    yield broker
    broker.kill()


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def test_nothing_hostile_moves_a_robot_or_stops_its_heart(broker: Broker, stack: ExitStack) -> None:
    robots = stack.enter_context(Robots("127.0.0.1", broker.port))
    pilot = stack.enter_context(Pilot(broker.port))
    robots.wait_online()
    began = time.monotonic()
    for number, payload in enumerate((*HOSTILE, *HUGE)):
        for kind in KINDS:
            pilot.send(kind, payload, qos=number % 2)
        time.sleep(EVERY_S)
    assert until(lambda: all(pilot.beating(kind, began) > 2.5 * RATE_HZ for kind in KINDS))
    for kind in KINDS:
        assert robots.moves[kind] == []
        stamps = [body["t"] for at, body in pilot.beats[kind] if at > began]
        assert (len(stamps) - 1) / (stamps[-1] - stamps[0]) * 1000 == pytest.approx(RATE_HZ, rel=0.1)
        assert robots.robots[kind].online
        pilot.drive(kind, 0.0, 0.8)
    assert until(lambda: all(map(robots.moving, KINDS)))
    assert until(lambda: not any(map(robots.moving, KINDS)))
    assert robots.alive


def test_a_kept_command_moves_nobody_who_connects_or_comes_back(broker: Broker, stack: ExitStack) -> None:
    pilot = stack.enter_context(Pilot(broker.port))
    for kind in KINDS:
        info = pilot.send(kind, b'{"x": 0, "z": 1}', retain=True)
        assert info is not None
        info.wait_for_publish(5)
    robots = stack.enter_context(Robots("127.0.0.1", broker.port))
    robots.wait_online()
    for robot in robots.robots.values():
        robot.network.radio.lose()
    assert until(lambda: not any(robot.online for robot in robots.robots.values()))
    for robot in robots.robots.values():
        robot.network.radio.restore()
    robots.wait_online()
    back = time.monotonic()
    assert until(lambda: all(pilot.beating(kind, back) > 2 for kind in KINDS))
    assert [robots.moves[kind] for kind in KINDS] == [[], []]
    assert all(robot.refused >= 2 for robot in robots.firmware())


def test_messages_without_end_do_not_keep_the_motors_on(broker: Broker, stack: ExitStack) -> None:
    """Nonsense at a high rate feeds no dead-man, and a stop is obeyed in the middle of it."""
    robots = stack.enter_context(Robots("127.0.0.1", broker.port))
    pilot = stack.enter_context(Pilot(broker.port))
    robots.wait_online()
    for kind in KINDS:
        pilot.drive(kind, 0.0, 0.8)
    assert until(lambda: all(map(robots.moving, KINDS)))
    end = time.monotonic() + 1.5
    while time.monotonic() < end:
        for kind in KINDS:
            pilot.send(kind, b'{"x": 0, "z": NaN}')
        time.sleep(0.003)
    assert not any(map(robots.moving, KINDS))
    assert robots.alive
