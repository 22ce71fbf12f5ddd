"""A broker that holds small messages back, behind a network with a delay, and one that does not."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from pebble.bench.impair.conditions import Condition, Shape
from pebble.bench.impair.network import REMOTE_HOST, NamespaceNetwork
from pebble.checks.broker.account import robot_account
from pebble.rig.processes import Processes, python
from pebble.transports.settings import MqttSettings
from tests.bench.impair.conftest import namespaces_permitted as namespaces_permitted
from tests.sparing_broker import SparingBroker
from tests.support import Broker

DELAY = Shape(delay_ms=40)
THIN = Shape(kbit=9.6, delay_ms=150)  # on which a message takes as long as many a round trip


@pytest.fixture
def network(namespaces_permitted: None) -> Iterator[NamespaceNetwork]:
    with closing(NamespaceNetwork("of a test")) as made:
        yield made


@pytest.mark.parametrize(
    "shape", [pytest.param(DELAY, id="delayed"), pytest.param(THIN, id="thin", marks=pytest.mark.thorough)]
)
@pytest.mark.parametrize(
    ("options", "expected"),
    [((), "it holds them back"), (("set_tcp_nodelay true",), "are passed on at once")],
    ids=["stock", "nodelay"],
)
def test_doctor_names_a_broker_that_holds_small_messages_back(
    network: NamespaceNetwork, tmp_path: Path, shape: Shape, options: tuple[str, ...], expected: str
) -> None:
    network.apply(Condition("slow", shape, shape))
    with Processes() as processes:
        broker = processes.broker(host=REMOTE_HOST, wrap=network.on_remote, extra=options)
        config = tmp_path / "goob.json"
        remote = {"remote_mqtt": {"host": REMOTE_HOST, "port": broker.port}}
        transport = {"kind": "zenoh", "run_dir": str(tmp_path / "run"), "state_dir": str(tmp_path / "state")}
        services = {"mqtt_bridge": {"enabled": True, **remote}}
        config.write_text(json.dumps({"robot": {"id": "goob"}, "transport": transport, "services": services}))
        command = network.on_robot(python("pebble.cli", "doctor", config))
        found = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False).stdout
    assert expected in " ".join(found.split()), found
    assert ("fix: in mosquitto.conf: set_tcp_nodelay true" in found) == (not options)


@pytest.mark.parametrize("loses_large", [False, True])
def test_a_round_trip_too_short_to_matter_is_not_judged(tmp_path: Path, loses_large: bool) -> None:
    broker = Broker(tmp_path)
    way = SparingBroker(broker.port, longest=1500 if loses_large else 1 << 28)
    settings = MqttSettings(host="127.0.0.1", port=way.port)
    accepts, *more = [result.text for result in robot_account("b", settings, "pebble/robots/goob")]
    way.close()
    broker.stop()
    assert accepts == "accepts what this account publishes"
    assert ["seems to lose large packets" in text for text in more] == [True] * loses_large
