"""What a broker retains of a robot, and that it is gone when Home Assistant is disabled."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from pebble.config import Config, parse
from pebble.contract import CAPABILITIES, CHARGING_LEVEL, codec
from pebble.contract.payloads import Capabilities, ChargingLevel
from pebble.services.homeassistant import service as s
from pebble.services.homeassistant.config import programs, saved
from pebble.transports import Message, MqttSettings, QoS, Transport, create
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.ext.homeassistant.test_discovery import EVERYTHING
from tests.kit.robot import Running
from tests.support import ROOT, Broker, until

TOPIC = "homeassistant/device/pebble_pebble_robots_goob/config"


def config(folder: Path, port: int, **section: Any) -> Config:
    services = {
        "mqtt_bridge": {"enabled": True, "remote_mqtt": {"host": "127.0.0.1", "port": port}},
        "homeassistant": section,
    }
    transport = {"kind": "zenoh", "state_dir": str(folder)}
    return parse({"robot": {"id": "goob"}, "transport": transport, "services": services}, folder=folder, env={})


@contextmanager
def robot(config: Config) -> Iterator[Transport]:
    """Run the service, and give a transport of the robot."""
    hub = MemoryHub()
    running = Running(s.HomeAssistantService(config, MemoryTransport("homeassistant", hub)))
    with MemoryTransport("robot", hub) as transport:
        offer = Capabilities(t=1, value=EVERYTHING)
        transport.publish(CAPABILITIES.topic(config.base), codec.encode(CAPABILITIES, offer), retain=True)
        yield transport
        running.stop()
        assert running.error is None, running.error


class Watching:
    """A client of the broker, and what it has received."""

    def __init__(self, broker: Broker) -> None:
        self.messages: list[Message] = []
        self.transport = create("mqtt", "home", MqttSettings(host="127.0.0.1", port=broker.port)).open(5)
        self.transport.subscribe("homeassistant/#", self.messages.append, qos=QoS.DELIVERED, direct=True)
        self.transport.subscribe("elsewhere/#", self.messages.append, qos=QoS.DELIVERED, direct=True)

    def devices(self) -> list[Message]:
        return [message for message in list(self.messages) if message.topic.endswith("/config")]


@pytest.fixture
def home(broker: Broker) -> Iterator[Watching]:
    watching = Watching(broker)
    yield watching
    watching.transport.close()


def retained(broker: Broker) -> dict[str, bytes]:
    watching = Watching(broker)
    watching.transport.close()
    return {message.topic: message.payload for message in watching.devices()}


def test_it_is_announced_again_when_home_assistant_starts_and_on_changes(
    tmp_path: Path, broker: Broker, home: Watching
) -> None:
    with robot(config(tmp_path, broker.port, enabled=True)) as local:
        assert until(lambda: len(home.devices()) == 1)
        assert (home.devices()[0].topic, int(home.devices()[0].qos)) == (TOPIC, 1)
        assert retained(broker)[TOPIC] == home.devices()[0].payload
        home.transport.publish("homeassistant/status", b"offline", qos=QoS.DELIVERED)
        home.transport.publish("homeassistant/status", b"online", qos=QoS.DELIVERED)
        assert until(lambda: len(home.devices()) == 2)
        for volts in (7.4, 7.3):
            level = codec.encode(CHARGING_LEVEL, ChargingLevel(value=volts))
            local.publish(CHARGING_LEVEL.topic("pebble/robots/goob"), level, retain=True)
        assert until(lambda: len(home.devices()) == 3)
        assert "battery" in json.loads(home.devices()[2].payload)["cmps"]
        broker.kill()  # and it forgets all
        broker.start()
        assert until(lambda: TOPIC in retained(broker), 20)
    assert TOPIC in retained(broker)  # the robot is away, and Home Assistant still knows it


def test_changes_are_apart(tmp_path: Path, broker: Broker, home: Watching, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(s, "APART_S", 3600.0)
    with robot(config(tmp_path, broker.port, enabled=True)) as local:
        assert until(lambda: len(home.devices()) == 1)
        for unit in ("v", "%"):
            level = codec.encode(CHARGING_LEVEL, ChargingLevel(value=7, unit=unit))
            local.publish(CHARGING_LEVEL.topic("pebble/robots/goob"), level, retain=True)
        home.transport.publish("homeassistant/status", b"online", qos=QoS.DELIVERED)
        assert not until(lambda: len(home.devices()) > 1, 1)


@pytest.mark.parametrize("change", [{"enabled": False}, {"enabled": True, "prefix": "elsewhere"}])
def test_what_an_earlier_config_announced_is_emptied_once_the_broker_is_there(
    tmp_path: Path, change: dict[str, Any]
) -> None:
    broker = Broker(tmp_path, persistence=True)
    with robot(config(tmp_path, broker.port, enabled=True)):
        assert until(lambda: TOPIC in retained(broker))
    later = config(tmp_path, broker.port, **change)
    assert [program.name for program in programs(later)] == ["homeassistant"]
    broker.stop()
    with robot(later):
        assert not until(lambda: not saved(later).exists(), 1)  # nothing is forgotten meanwhile
        broker.start()
        stays = ["homeassistant"] if change["enabled"] else []
        assert until(lambda: TOPIC not in retained(broker), 20)
        assert until(lambda: not saved(later).exists() or TOPIC not in saved(later).read_text())
        assert until(lambda: len(retained(broker)) == len(stays))
    assert [program.name for program in programs(later)] == stays
    broker.stop()


def test_a_robot_that_enables_none_runs_and_imports_nothing_of_it(tmp_path: Path) -> None:
    assert programs(config(tmp_path, 1883)) == []
    script = """
import sys
from pebble.config import load
from pebble.launcher import launcher, programs
config = load("configs/goob.json", env={})
assert "homeassistant" not in {program.name for program in programs.programs(config)}
extensions = ("pebble.services.homeassistant.", "pebble.extensions.metrics.")
print(sorted(name for name in sys.modules if name.startswith(extensions)))
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stdout == "['pebble.services.homeassistant.config']\n", done.stderr
