"""The `net` fixture: every test of the shared suite runs once per kind of transport.

To plug a kind in: write a `Net` (tests/transports/net.py), and add its factory to `NETS`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.transports.memory_net import MemoryNet
from tests.transports.mqtt_net import MqttNet
from tests.transports.net import Net
from tests.transports.zenoh_net import ZenohNet

NETS: dict[str, Callable[[Path, str], Net]] = {
    "memory": lambda _folder, _client: MemoryNet(),
    "mqtt311": lambda folder, client: MqttNet(folder, "3.1.1", client),
    "mqtt5": lambda folder, client: MqttNet(folder, "5", client),
    "zenoh": lambda folder, _client: ZenohNet(folder),
}
_numbers = itertools.count(1)


#: A kind, and the client library below it.
KINDS = [(kind, "") for kind in NETS] + [
    pytest.param((kind, "paho"), marks=pytest.mark.thorough) for kind in ("mqtt311", "mqtt5")
]


@pytest.fixture(scope="module", params=KINDS, ids=lambda one: "-".join(filter(None, one)))
def network(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Net]:
    """One per module and kind; its broker or hub is started."""
    kind, client = request.param
    net = NETS[kind](tmp_path_factory.mktemp("net"), client or "pebble")
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
