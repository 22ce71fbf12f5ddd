"""Gateways that share robots: killed, hung and cut off from either side, while the robots are driven and stopped."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.fleet.gateway_rig import FAULTS, NEVER, World, world
from tests.robot.operator import Driver, retained_messages
from tests.robot.rig import BASE, Rig
from tests.support import cases, further, until
from tests.transports.forked import Forked

pytestmark = pytest.mark.alone
FAULT_S = 5.0  # longer than everything that notices it takes
OUTAGE_S, ALL_S, STOP_S = 4.0, 5.0, 1.0


@pytest.fixture(scope="module", params=[2, pytest.param(3, marks=pytest.mark.thorough)])
def hall(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    with world(tmp_path_factory.mktemp("gateways"), request.param) as made:
        yield made


@pytest.mark.parametrize("fault", ["kill", *map(further, sorted(FAULTS.keys() - {"kill"}))])
def test_a_gateway_that_fails_loses_its_robots_to_another(hall: World, fault: str) -> None:
    outages, stops = [], []
    names = sorted(hall.gateways)
    for case in range(cases(1, 10 if fault == "kill" else 5)):  # two and three gateways: twice as many
        began = time.monotonic()
        mend = FAULTS[fault](hall.gateways[names[case % len(names)]])
        stops.append(hall.stop())
        assert until(lambda began=began: hall.driven(began + 1.5), 10)
        while time.monotonic() < began + cases(0, int(FAULT_S)):
            stops.append(hall.stop())
            time.sleep(0.5)
        mend()
        stops.append(hall.stop())
        hall.wait_until_shared()
        outages.append(hall.outage_s(began))
    figures = {
        "outage": max(outages),
        "stop": max(stops),
        "cases": len(outages),
        "p50 ms": hall.p50_ms(),
        **hall.wrong(),
    }
    sys.stdout.write(f"\n{len(names)} gateways, {fault}: {json.dumps(figures)}\n")
    assert hall.wrong() == dict.fromkeys(NEVER, 0)
    assert max(outages) <= OUTAGE_S
    assert max(stops) <= STOP_S


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
    began, flooder = time.monotonic(), Forked("tests.fleet.flooder", hall.broker.port, topic)
    try:
        stops = [hall.stop("r3") for _ in range(20)]
    finally:
        flooder.kill()
        flooder.wait(10)
    outage = hall.outage_s(began, "r3")
    hall.wait_until_shared()
    sys.stdout.write(f"\n{topic}: outage {outage:.2f} s, stop {max(stops):.3f} s\n")
    assert hall.wrong() == dict.fromkeys(NEVER, 0)
    assert outage <= OUTAGE_S / 4
    assert max(stops) <= STOP_S


@pytest.mark.thorough
def test_the_two_hundred_robots_of_a_gateway_that_dies_are_soon_carried_again(tmp_path: Path) -> None:
    with world(tmp_path, 2, 400, proxied=False, many=True) as hall:
        began = time.monotonic()
        hall.gateways["gate-0"].kill()
        stop = hall.stop()
        assert until(lambda: hall.driven(began), 60)
        took = time.monotonic() - began
        sys.stdout.write(f"\n400 robots, half of them of a gateway that dies: {took:.1f} s; a stop {stop:.2f} s\n")
        assert hall.wrong() == dict.fromkeys(NEVER, 0)
        assert took <= ALL_S
        assert stop <= STOP_S


@pytest.mark.thorough
def test_what_a_command_takes_through_a_gateway(tmp_path: Path) -> None:
    """A figure for docs/fleet.md: how long commands take, and those that a robot at the broker itself receives."""
    with world(tmp_path, 1, 2, proxied=False) as hall:
        assert until(lambda: len(hall.robots[0].commands) > cases(200, 1000), 60)
        sys.stdout.write(f"\np50 in ms through a gateway, and without: {hall.p50_ms()}\n")
        assert hall.wrong() == dict.fromkeys(NEVER, 0)


@pytest.mark.thorough
def test_a_whole_robot_is_driven_and_stopped_through_a_gateway_that_dies(tmp_path: Path) -> None:
    with world(tmp_path, 2, 1) as hall:
        remote = {"kind": "zenoh", "connect": [f"tcp/127.0.0.1:{hall.hub_port}"]}
        with Rig("zenoh", remote=hall.broker, mqtt_bridge={"remote": remote}) as rig:
            assert {"outgoing/capabilities", "outgoing/status"} <= retained_messages(hall.broker.port, BASE).keys()
            driver = Driver(rig.operator)
            assert until(rig.mcu.turning, 10)
            for one in hall.gateways.values():
                began = time.monotonic()
                one.kill()
                assert until(lambda began=began: rig.mcu.moving(began + 0.75), 10), "the other carries it"
                one.start()
                hall.wait_until_shared()
            stopped = time.monotonic()
            rig.operator.send("incoming/estop", {"stop": "s" * 16, "by": "ann"})
            assert until(lambda: not rig.mcu.turning(), 1)
            assert rig.operator.wait_for("outgoing/estop/serial", since=stopped).json["latched"]
            driver.stop()
        assert hall.wrong() == dict.fromkeys(NEVER, 0)
