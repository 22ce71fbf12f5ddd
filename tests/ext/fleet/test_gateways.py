"""A gateway that is killed, hangs and is cut off from either side, while its robots are driven and stopped."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.ext.fleet.gateway_rig import FAULTS, NEVER, World, world
from tests.robot.operator import Driver, retained_messages
from tests.robot.rig import BASE, Rig
from tests.support import cases, further, until
from tests.transports.forked import Forked

pytestmark = pytest.mark.alone
FAULT_S, FLOOD_S, SECOND_S = 2.0, 2.0, 10.0
BACK_S, ALL_S, STOP_S = 6.0, 12.0, 1.0


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    with world(tmp_path_factory.mktemp("gateways")) as made:
        yield made


@pytest.mark.parametrize("fault", ["kill", *map(further, sorted(FAULTS.keys() - {"kill"}))])
def test_after_a_fault_its_robots_are_driven_and_stopped_again(hall: World, fault: str) -> None:
    back, stops = [], []
    for _ in range(cases(1, 5)):
        mend = FAULTS[fault](hall.gateway)
        time.sleep(FAULT_S)
        mend()
        mended = time.monotonic()
        assert until(lambda mended=mended: hall.driven(mended), 30)
        back.append(time.monotonic() - mended)
        stops.append(hall.stop())
    figures = {"driven again": max(back), "stop": max(stops), "cases": len(back), **hall.wrong()}
    sys.stdout.write(f"\n{fault}: {json.dumps(figures)}\n")
    assert hall.wrong() == dict.fromkeys(NEVER, 0)
    assert max(back) <= BACK_S
    assert max(stops) <= STOP_S


def test_a_second_one_does_not_start_and_takes_over_where_it_is_tried_again(hall: World) -> None:
    """As systemd does; and the first one finds it then."""
    second, first = hall.process("gate-2"), hall.gateway
    assert second.ends(SECOND_S) == 1
    assert "gateway gate-2 does not start: gate-1 carries pebble/robots/r" in second.printed
    assert hall.wrong() == dict.fromkeys(NEVER, 0)
    first.kill()
    began = time.monotonic()
    second.start()
    assert until(lambda: hall.driven(began), SECOND_S)
    first.start()
    assert first.ends(SECOND_S) == 1
    second.close()
    first.start()
    hall.wait_until_carried()
    assert hall.wrong() == dict.fromkeys(NEVER, 0)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "topic",
    [
        "pebble/robots/nowhere/incoming/estop",  # as a viewer may; its payload is another one each time
        "pebble/robots/r0/incoming/estop",
        "pebble/robots/r0/incoming/front-camera",
        "pebble/robots/r0/incoming/lights-solid",  # as a driver may
        "pebble/robots/r0/incoming/mcu/u#/led",
    ],
)
def test_what_one_robot_is_sent_holds_up_no_other(hall: World, topic: str) -> None:
    began, flooder = time.monotonic(), Forked("tests.ext.fleet.flooder", hall.broker.port, topic)
    try:
        time.sleep(FLOOD_S)
        stops = []
        while time.monotonic() < began + 2 * FLOOD_S:
            stops.append(hall.stop("r3"))
            time.sleep(0.1)
    finally:
        flooder.kill()
        flooder.wait(10)
    outage = hall.outage_s(began, "r3")
    hall.wait_until_carried()
    sys.stdout.write(f"\n{topic}: outage {outage:.2f} s, stop {max(stops):.3f} s\n")
    assert hall.wrong() == dict.fromkeys(NEVER, 0)
    assert outage <= STOP_S
    assert max(stops) <= STOP_S


@pytest.mark.thorough
def test_four_hundred_robots_are_soon_carried_again(tmp_path: Path) -> None:
    with world(tmp_path, 400, proxied=False, many=True) as hall:
        hall.gateway.kill()
        began = time.monotonic()
        hall.gateway.start()
        assert until(lambda: hall.driven(began), 60)
        took, stop = time.monotonic() - began, hall.stop()
        sys.stdout.write(f"\n400 robots of a gateway that is started again: {took:.1f} s; a stop {stop:.2f} s\n")
        assert hall.wrong() == dict.fromkeys(NEVER, 0)
        assert took <= ALL_S
        assert stop <= STOP_S


@pytest.mark.thorough
def test_what_a_command_takes_through_a_gateway(tmp_path: Path) -> None:
    """A figure for docs/many.md: how long commands take, and those that a robot at the broker itself receives."""
    with world(tmp_path, 2, proxied=False) as hall:
        assert until(lambda: len(hall.robots[0].commands) > cases(200, 1000), 60)
        sys.stdout.write(f"\np50 in ms through a gateway, and without: {hall.p50_ms()}\n")
        assert hall.wrong() == dict.fromkeys(NEVER, 0)


@pytest.mark.thorough
def test_a_whole_robot_is_driven_and_stopped_through_a_gateway_that_is_started_again(tmp_path: Path) -> None:
    with world(tmp_path, 1) as hall:
        remote = {"kind": "zenoh", "connect": [f"tcp/127.0.0.1:{hall.hub_port}"]}
        with Rig("zenoh", remote=hall.broker, mqtt_bridge={"remote": remote}) as rig:
            assert {"outgoing/capabilities", "outgoing/status"} <= retained_messages(hall.broker.port, BASE).keys()
            driver = Driver(rig.operator)
            assert until(rig.mcu.turning, 10)
            began = time.monotonic()
            hall.gateway.kill()
            assert until(lambda: not rig.mcu.turning(), 2), "nothing commands it"
            hall.gateway.start()
            assert until(lambda: rig.mcu.moving(began + 0.75), 10)
            stopped = time.monotonic()
            rig.operator.send("incoming/estop", {"stop": "s" * 16, "by": "ann"})
            assert until(lambda: not rig.mcu.turning(), 1)
            assert rig.operator.wait_for("outgoing/estop/serial", since=stopped).json["latched"]
            driver.stop()
        assert hall.wrong() == dict.fromkeys(NEVER, 0)
