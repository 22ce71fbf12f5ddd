"""Whole robots to test, one per way of being wired, each started once per module."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass

import pytest

from tests.robot.operator import Operator
from tests.robot.rig import BASE, Rig
from tests.support import further


@dataclass
class Station:
    """A robot and an operator who drives it from one of its brokers."""

    rig: Rig
    operator: Operator


def _station(wiring: str) -> Iterator[Station]:
    if wiring == "mirror":
        with Rig("zenoh", mirror=True) as rig:
            assert rig.local is not None
            operator = Operator(rig.local.port, BASE)
            operator.wait_for("outgoing/status")
            yield Station(rig, operator)
            operator.close()
    else:
        with Rig(wiring) as rig:
            yield Station(rig, rig.operator)


@pytest.fixture(scope="module", params=["mqtt", "zenoh", further("single"), "mirror"])
def station(request: pytest.FixtureRequest) -> Iterator[Station]:
    """An operator at the remote broker, at the only broker, or at the local broker of a Zenoh robot."""
    yield from _station(request.param)


@pytest.fixture(scope="module", params=["mqtt", "zenoh", further("single")])
def uplinked(request: pytest.FixtureRequest) -> Iterator[Station]:
    """Only robots with an uplink to a remote broker: for tests of heartbeat, wills and uplink."""
    yield from _station(request.param)


@pytest.fixture(scope="module", params=["mqtt", "zenoh"])
def driven(request: pytest.FixtureRequest) -> Iterator[Rig]:
    """A robot to break things on."""
    with Rig(request.param, mcu="fred") as rig:
        yield rig


@pytest.fixture
def quiet() -> Iterator[None]:
    """Let services log nothing, which would take most of the time of what runs in virtual time."""
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)
