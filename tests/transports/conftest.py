"""The `net` fixture: every test of the shared suite runs once per kind of transport.

To plug a kind in: write a `Net` (tests/transports/net.py), and add its factory to `NETS`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.transports.net import MemoryNet, MqttNet, Net, PahoNet
from tests.transports.zenoh_net import ZenohNet

NETS: dict[str, Callable[[Path], Net]] = {
    "memory": lambda _folder: MemoryNet(),
    "mqtt311": lambda folder: MqttNet(folder, "3.1.1"),
    "mqtt5": lambda folder: MqttNet(folder, "5"),
    "zenoh": ZenohNet,
    "paho311": lambda folder: PahoNet(folder, "3.1.1"),
    "paho5": lambda folder: PahoNet(folder, "5"),
}
_numbers = itertools.count(1)


KINDS = [pytest.param(kind, marks=[pytest.mark.thorough] if kind.startswith("paho") else []) for kind in NETS]


@pytest.fixture(scope="module", params=KINDS)
def network(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Net]:
    """One per module and kind; its broker or hub is started."""
    net = NETS[request.param](tmp_path_factory.mktemp("net"))
    net.start_network()
    yield net
    net.stop()


@pytest.fixture
def net(network: Net) -> Iterator[Net]:
    """The network, without the clients of other tests."""
    yield network
    network.heal()
    network.close_clients()


@pytest.fixture
def base() -> str:
    """A topic prefix no other test uses."""
    return f"pebble/test/n{next(_numbers)}"
