"""A robot's local transport of either kind, shared by the tests of a module."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.ext.scripts.script.station import Station

#: For what depends on the transport: how a process ends.
BOTH = pytest.mark.parametrize("shared", ["mqtt", "zenoh"], indirect=True)


@pytest.fixture(scope="module", params=["mqtt", pytest.param("zenoh", marks=pytest.mark.thorough)])
def shared(request: pytest.FixtureRequest) -> Iterator[Station]:
    station = Station(request.param)
    yield station
    station.close()


@pytest.fixture
def station(shared: Station) -> Station:
    """Nothing was received, and the motor owner is free."""
    shared.publish_state()
    shared.received.clear()
    return shared
