"""Surroundings of a program under test: two brokers, or a local transport with MCUs on serial lines."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.commands.conftest import run as run
from tests.kit.board import SerialRig
from tests.kit.robot import LocalNetwork
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


@pytest.fixture(scope="session", params=["memory", "mqtt", "zenoh"])
def network(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[LocalNetwork]:
    """Make a broker or a hub for all robots of a run."""
    network = LocalNetwork(request.param, tmp_path_factory.mktemp("network"))
    yield network
    network.close()


@pytest.fixture
def rig(network: LocalNetwork, tmp_path: Path) -> Iterator[SerialRig]:
    """MCUs and their bridges, on each transport."""
    rig = SerialRig(network.kind, tmp_path, network)
    yield rig
    rig.close()


@pytest.fixture
def memory_rig(tmp_path: Path) -> Iterator[SerialRig]:
    rig = SerialRig("memory", tmp_path)
    yield rig
    rig.close()
