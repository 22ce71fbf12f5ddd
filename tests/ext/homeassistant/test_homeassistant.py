"""The message for Home Assistant, by which nothing moves a robot, and what a broker retains of it."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from pebble.config import Config, load, parse
from pebble.contract import CAPABILITIES, CHARGING_LEVEL, LIGHTS_SOLID, codec
from pebble.contract.names import without_name
from pebble.contract.payloads import Capabilities, ChargingLevel, LightsSolid
from pebble.errors import ConfigError
from pebble.launcher.capabilities import capabilities
from pebble.motion.latch import stop_of
from pebble.runtime.addresses import Addresses
from pebble.services.homeassistant import service as s
from pebble.services.homeassistant.config import facts, programs, saved
from pebble.services.homeassistant.discovery import discovery, object_id
from pebble.transports import Message, MqttSettings, QoS, Transport, create
from pebble.transports.memory import MemoryHub, MemoryTransport
from tests.kit.robot import Running
from tests.support import ROOT, WAIT_S, Broker, until

CONFIGS = sorted(path for path in (ROOT / "configs").glob("*.json") if path.name != "schema.json")
PAGE = (ROOT / "docs" / "ext" / "homeassistant.md").read_text()
#: What Home Assistant needs of each part, besides its kind, name and id; "ret" would have a command retained.
KEYS = {
    "presence": "stat_t val_tpl src_type",
    "stop": "cmd_t qos cmd_tpl",
    "restart": "cmd_t qos pl_prs dev_cla",
    "reboot": "cmd_t qos pl_prs dev_cla",
    "battery": "dev_cla unit_of_meas stat_t val_tpl exp_aft",
    "charging": "dev_cla stat_t val_tpl",
    "stopped": "dev_cla stat_t val_tpl",
    "camera": "t",
    "video": "stat_t val_tpl pl_on pl_off ret cmd_t qos",
    "light": "schema cmd_on_tpl cmd_off_tpl r_tpl g_tpl b_tpl cmd_t qos",
}
BASE = "pebble/robots/goob"
EVERYTHING = {
    "identity": {"name": "Goob", "description": "Rover"},
    "drive": {"available": True, "controls": True, "control": True},
    "estop": {"available": True, "owners": [f"{number}{'o' * 60}" for number in range(16)]},
    "video": {"controls": True, "encoding": "jpeg"},
    "lights": {"solid": True},
    "telemetry": {"charging_status": True},
    "autonomy": {"available": True, "controls": True},
    "system": {name: {"available": True, "controls": True} for name in ("reboot", "service_restart", "git_pull")},
}
FOREIGN = {
    **EVERYTHING,
    "lights": {"solid": True, "solid_topic": "pebble/robots/fred/incoming/lights-solid"},
    "video": {"controls": True, "flag_topic": f"{BASE}/incoming/drive-values", "encoding": "jpeg"},
    "system": {"reboot": {"controls": True, "flag_topic": f"{BASE}/incoming/estop-reset"}},
}


def read(path: Path) -> tuple[str, dict[str, Any]]:
    config = load(path, env={})
    return config.base, capabilities(config, Addresses(config))


ROBOTS = {
    **{path.stem: read(path) for path in CONFIGS},
    "everything": (BASE, EVERYTHING),
    "names": (BASE, {**EVERYTHING, "named": True}),
    "topics of others": (BASE, FOREIGN),
    "nonsense": (BASE, {"identity": 7, "estop": {"available": True, "owners": "serial"}, "video": []}),
}


@pytest.mark.parametrize("unit", ["v", "%", ""])
@pytest.mark.parametrize("robot", ROBOTS)
def test_each_robot_has_a_valid_message_by_which_nothing_moves(robot: str, unit: str) -> None:
    base, offered = ROBOTS[robot]
    raw = discovery(base, offered, ("restart", "reboot"), unit)
    assert len(raw) <= 8000
    message = json.loads(raw)
    assert (message.keys(), message["dev"].keys()) == ({"dev", "o", "cmps"}, {"ids", "name", "mf", "mdl", "sw"})
    assert all(message["dev"].values())
    components = message["cmps"]
    assert len(components) <= 24
    for key, part in components.items():
        kind = key.partition("_")[0]
        availability = {"avty_t", "avty_tpl"} if kind != "presence" else set[str]()
        assert set(part) == {*KEYS[kind].split(), "p", "name", "uniq_id"} | availability
        assert part.get("qos", 1) == 1
    topics = [part[key] for part in components.values() for key in ("t", "stat_t", "cmd_t", "avty_t") if key in part]
    assert all(topic.startswith(f"{base}/") for topic in topics)
    commands = {key: part["cmd_t"] for key, part in components.items() if "cmd_t" in part}
    plain = {key: named.topic if (named := without_name(topic)) else topic for key, topic in commands.items()}
    allowed = {"stop": "estop", "video": "flags/mqtt-video", "light": "lights-solid"}
    allowed |= {"restart": "flags/service-restart", "reboot": "flags/reboot"}
    assert plain == {key: f"{base}/incoming/{allowed[key]}" for key in commands}
    with_name = {key for key, topic in commands.items() if "/incoming/by/homeassistant/" in topic}
    assert with_name == (commands.keys() - {"stop"} if offered.get("named") else set())
    retained = {key for key, part in components.items() if part.get("ret")}
    assert retained == (components.keys() & {"video"} if not with_name else set()), "nothing with a name"
    assert ("battery" in components) is bool(unit)
    ids = [part["uniq_id"] for part in components.values()]
    assert len(set(ids)) == len(ids)


def test_what_a_robot_offers_is_there_and_only_what_is_exposed() -> None:
    components = json.loads(discovery(BASE, EVERYTHING, (), "v"))["cmps"]
    assert [*components][:7] == ["presence", "stop", "battery", "charging", "camera", "video", "light"]
    assert {key.partition("_")[0] for key in [*components][7:]} == {"stopped"}
    assert [*json.loads(discovery(BASE, EVERYTHING, ("reboot",)))["cmps"]][6] == "reboot"
    assert [*json.loads(discovery(BASE, {}))["cmps"]] == ["presence"]


def test_what_it_sends_is_understood() -> None:
    components = json.loads(discovery(BASE, EVERYTHING))["cmps"]
    stop = re.sub(r"{{ '%016x' .+? }}", "00066171a4181e4e", components["stop"]["cmd_tpl"])
    assert stop_of(json.loads(stop)) == ("00066171a4181e4e", "homeassistant", "")
    light = re.sub(r"{{.+?}}", "0.5", components["light"]["cmd_on_tpl"])
    assert codec.decode(LIGHTS_SOLID, light.encode()) == LightsSolid(r=0.5, g=0.5, b=0.5)
    assert codec.decode(LIGHTS_SOLID, components["light"]["cmd_off_tpl"].encode()) == LightsSolid()


def test_no_two_robots_have_one_id() -> None:
    bases = ("a/b/c", "a_b/c/d", "a/b_c/d", "a/b/c d", "a/b/c_d", "a/b/ä", "a/b/ö", BASE)
    ids = [object_id(base) for base in bases]
    assert len({*ids}) == len(bases)
    assert ids[0] == "pebble_a_b_c"
    assert all(re.fullmatch(r"[A-Za-z0-9_-]+", name) for name in ids)


def test_the_config_of_the_page_is_one_and_needs_a_broker() -> None:
    (snippet,) = (json.loads(text) for text in re.findall(r"```json\n(.*?)```", PAGE, re.DOTALL))
    config = parse(snippet, folder=Path("/"), env={})
    assert config.warnings == ()
    assert facts(config).lines == (("home assistant", "homeassistant, buttons: stop, restart"),)
    snippet["services"]["mqtt_bridge"]["enabled"] = False
    (warning,) = parse(snippet, folder=Path("/"), env={}).warnings
    assert warning.startswith("services.homeassistant.enabled: is not used without a remote broker by MQTT")
    snippet["services"]["homeassistant"] |= {"expose": ["drive"]}
    with pytest.raises(ConfigError, match=r"services\.homeassistant\.expose"):
        parse(snippet, folder=Path("/"), env={})


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
        self.transport = create("mqtt", "home", MqttSettings(host="127.0.0.1", port=broker.port)).open(WAIT_S)
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
    tmp_path: Path, broker: Broker, home: Watching, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(s, "APART_S", 0.2)
    with robot(config(tmp_path, broker.port, enabled=True)) as local:
        assert until(lambda: len(home.devices()) == 1)
        assert (home.devices()[0].topic, int(home.devices()[0].qos)) == (TOPIC, 1)
        assert retained(broker)[TOPIC] == home.devices()[0].payload
        assert not until(lambda: len(home.devices()) > 1, 1), "without a reason it is not sent again"
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
        assert until(lambda: TOPIC in retained(broker))
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
        assert until(lambda: TOPIC not in retained(broker))
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
