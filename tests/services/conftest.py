"""What surrounds a program under test: two brokers, or a local transport with MCUs on serial lines."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.services.serial_mcu_bridge.mcu_rig import Rig
from tests.support import Broker


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Broker]:
    """The robot's own."""
    broker = Broker(tmp_path_factory.mktemp("local"))
    yield broker
    broker.stop()


@pytest.fixture
def remote(tmp_path: Path) -> Iterator[Broker]:
    """The operators'."""
    broker = Broker(tmp_path)
    yield broker
    broker.stop()


@pytest.fixture(params=["memory", "mqtt", "zenoh"])
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Rig]:
    """MCUs and their bridges, on each transport."""
    rig = Rig(request.param, tmp_path)
    yield rig
    rig.close()


@pytest.fixture
def memory(tmp_path: Path) -> Iterator[Rig]:
    rig = Rig("memory", tmp_path)
    yield rig
    rig.close()
