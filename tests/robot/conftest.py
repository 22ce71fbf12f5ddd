"""Whole robots to test, one per way of being wired, each started once per module."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import pytest

from tests.robot.operator import Operator
from tests.robot.rig import BASE, Rig


@dataclass
class Seat:
    """A robot and an operator who drives it from one of its brokers."""

    rig: Rig
    operator: Operator


def _seat(wiring: str) -> Iterator[Seat]:
    if wiring == "mirror":
        with Rig("zenoh", mirror=True) as rig:
            assert rig.local is not None
            operator = Operator(rig.local.port, BASE)
            operator.wait_for("outgoing/status")
            yield Seat(rig, operator)
            operator.close()
    else:
        with Rig(wiring) as rig:
            yield Seat(rig, rig.operator)


@pytest.fixture(scope="module", params=["mqtt", "zenoh", "single", "mirror"])
def seat(request: pytest.FixtureRequest) -> Iterator[Seat]:
    """Whatever the operator sits at: the remote broker, the one and only broker, or a Zenoh robot's local broker."""
    yield from _seat(request.param)


@pytest.fixture(scope="module", params=["mqtt", "zenoh", "single"])
def uplinked(request: pytest.FixtureRequest) -> Iterator[Seat]:
    """What concerns the way to the remote broker: heartbeat, wills, uplink."""
    yield from _seat(request.param)


@pytest.fixture(scope="module", params=["mqtt", "zenoh"])
def driven(request: pytest.FixtureRequest) -> Iterator[Rig]:
    """A robot to break things on."""
    with Rig(request.param, mcu="fred") as rig:
        yield rig
