"""The bridge with a Zenoh uplink instead of an MQTT one: the same code, the same outcome."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from pebble.forwarding.side import Gate
from pebble.services.mqtt_bridge.service import MqttBridge
from pebble.transports import State, ZenohSettings, create
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.services.mqtt_bridge.bridge_rig import Client, Quiet, Running, gate_of, make_config
from tests.support import ROOT, free_port, until

DRIVE = "incoming/drive-values"
FLAG = "incoming/flags/mqtt-video"
TRUE, FALSE = b"true", b"false"


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Where operators meet: a hub that listens on the loopback address."""
    where = f"tcp/127.0.0.1:{free_port()}"
    settings = msgspec.json.encode(
        ZenohSettings(run_dir=tmp_path_factory.mktemp("hub"), listen=(where,)), enc_hook=str
    ).decode()
    hub = subprocess.Popen([sys.executable, "-m", "pebble.runtime.hub", settings], cwd=ROOT)
    yield where
    hub.terminate()
    hub.wait(10)


class TestZenohUplink:
    @pytest.fixture
    def operator(self, endpoint: str, tmp_path: Path) -> Iterator[Client]:
        settings = ZenohSettings(run_dir=tmp_path, connect=(endpoint,), client=True)
        client = Client(create("zenoh", "operator", settings))
        yield client
        client.transport.close()

    @pytest.fixture
    def hub(self) -> MemoryHub:
        return MemoryHub()

    @pytest.fixture
    def local(self, hub: MemoryHub) -> Iterator[Client]:
        client = Client(MemoryTransport("somebody", hub))
        yield client
        client.transport.close()

    def test_everything_that_an_mqtt_uplink_does(
        self, endpoint: str, operator: Client, hub: MemoryHub, local: Client
    ) -> None:
        local.publish(FLAG, TRUE, retain=True)
        operator.publish(FLAG, FALSE, retain=True)
        operator.publish("incoming/lights-solid", b"stale", retain=True)
        config = make_config(remote={"kind": "zenoh", "connect": [endpoint]})
        bridge = MqttBridge(config, MemoryTransport("local-bridge", hub))
        running = Running(bridge)
        assert until(lambda: gate_of(bridge) is Gate.OPEN and len(bridge.status.synchronized) == 2)
        assert until(lambda: local.payloads(FLAG) == [FALSE])
        for number in range(200):
            operator.publish(DRIVE, b"%d" % number)
            local.publish("outgoing/strange", b"%d" % number)
        assert until(lambda: len(local.on(DRIVE)) >= 200 and len(operator.on("outgoing/strange")) >= 200)
        Quiet(operator, local).wait()
        assert local.payloads(DRIVE) == operator.payloads("outgoing/strange") == [b"%d" % n for n in range(200)]
        assert not operator.on(DRIVE)
        assert not operator.on(FLAG)
        assert not local.on("incoming/lights-solid")
        assert set(json.loads(operator.payloads("outgoing/online")[-1])) == {"t"}
        running.stop()
        assert until(lambda: json.loads(operator.payloads("outgoing/online")[-1]).get("online") is False)
        assert operator.transport.state is State.CONNECTED
