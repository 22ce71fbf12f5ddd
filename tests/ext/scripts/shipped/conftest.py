"""A robot's local transport with a stand-in for its motor owner and its camera."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.ext.scripts.script.station import Station
from tests.ext.scripts.shipped.stand_in import Sensors


@pytest.fixture(scope="module", params=["zenoh", pytest.param("mqtt", marks=pytest.mark.thorough)])
def sensors(request: pytest.FixtureRequest) -> Iterator[Sensors]:
    station = Station(request.param)
    sensors = Sensors(station)
    yield sensors
    sensors.close()
    station.close()
