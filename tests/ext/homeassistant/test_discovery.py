"""The message for Home Assistant: its form, by a schema of our own, and that nothing in it moves a robot."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from pebble.config import load, parse
from pebble.contract import LIGHTS_SOLID, codec
from pebble.contract.names import without_name
from pebble.contract.payloads import LightsSolid
from pebble.errors import ConfigError
from pebble.launcher.capabilities import capabilities
from pebble.motion.latch import stop_of
from pebble.runtime.addresses import Addresses
from pebble.services.homeassistant.config import HomeAssistant, facts
from pebble.services.homeassistant.discovery import discovery, object_id
from tests.support import ROOT

CONFIGS = sorted(path for path in (ROOT / "configs").glob("*.json") if path.name != "schema.json")
PAGE = (ROOT / "docs" / "ext" / "homeassistant.md").read_text()
TEXT, TEMPLATE = {"type": "string", "minLength": 1}, {"type": "string", "pattern": r"\{\{ .+ \}\}"}
TOPIC = {"type": "string", "pattern": "^[^+#]+/(incoming|outgoing)/[^+#]+$"}


def component(platform: str, *, available: bool = True, **more: Any) -> dict[str, Any]:
    common = {"p": {"const": platform}, "name": TEXT, "uniq_id": {"type": "string", "pattern": "^pebble_"}}
    common |= {"avty_t": TOPIC, "avty_tpl": TEMPLATE} if available else {}
    properties = {**common, **more}
    return {"type": "object", "properties": properties, "required": [*properties], "additionalProperties": False}


COMMAND = {"cmd_t": TOPIC, "qos": {"const": 1}}  # and without "ret", which would have it retained
COLOURS = dict.fromkeys(("cmd_on_tpl", "r_tpl", "g_tpl", "b_tpl"), TEMPLATE)
FORMS = (
    component("device_tracker", available=False, stat_t=TOPIC, val_tpl=TEMPLATE, src_type={"const": "router"}),
    component("button", cmd_tpl=TEMPLATE, **COMMAND),
    component("button", pl_prs={"const": "true"}, dev_cla={"const": "restart"}, **COMMAND),
    component("sensor", dev_cla={"enum": ["voltage", "battery"]}, unit_of_meas={"enum": ["V", "%"]},
              stat_t=TOPIC, val_tpl=TEMPLATE, exp_aft={"type": "integer", "minimum": 60}),
    component("binary_sensor", dev_cla={"enum": ["battery_charging", "problem"]}, stat_t=TOPIC, val_tpl=TEMPLATE),
    component("camera", t=TOPIC),
    component("switch", stat_t=TOPIC, val_tpl=TEMPLATE, pl_on={"const": "true"}, pl_off={"const": "false"},
              ret={"type": "boolean"}, **COMMAND),
    component("light", schema={"const": "template"}, cmd_off_tpl=TEXT, **COLOURS, **COMMAND),
)  # fmt: skip
DEVICE = {"ids": {"type": "array", "items": TEXT}, **dict.fromkeys(("name", "mf", "mdl", "sw"), TEXT)}
SCHEMA = {
    "type": "object",
    "properties": {
        "dev": {"type": "object", "properties": DEVICE, "required": [*DEVICE], "additionalProperties": False},
        "o": {"type": "object", "properties": {"name": TEXT, "sw": TEXT}, "required": ["name"]},
        "cmps": {
            "type": "object",
            "propertyNames": {"pattern": "^[^/+#]{1,80}$"},
            "additionalProperties": {"oneOf": list(FORMS)},
            "maxProperties": 24,
        },
    },
    "required": ["dev", "o", "cmps"],
    "additionalProperties": False,
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
    jsonschema.Draft202012Validator(SCHEMA).validate(message)
    components = message["cmps"]
    topics = [part[key] for part in components.values() for key in ("t", "stat_t", "cmd_t", "avty_t") if key in part]
    assert all(topic.startswith(f"{base}/") for topic in topics)
    commands = {key: part["cmd_t"] for key, part in components.items() if "cmd_t" in part}
    plain = {key: named.topic if (named := without_name(topic)) else topic for key, topic in commands.items()}
    allowed = {"stop": "estop", "video": "flags/mqtt-video", "light": "lights-solid"}
    allowed |= {"restart": "flags/service-restart", "reboot": "flags/reboot"}
    assert plain == {key: f"{base}/incoming/{allowed[key]}" for key in commands}
    assert ("battery" in components) is bool(unit)
    ids = [part["uniq_id"] for part in components.values()]
    assert len(set(ids)) == len(ids)


def test_what_a_robot_offers_is_there_and_only_what_is_exposed() -> None:
    components = json.loads(discovery(BASE, EVERYTHING, (), "v"))["cmps"]
    first = ["presence", "stop", "battery", "charging", "camera", "video", "light"]
    assert [*components][:7] == first
    assert len(components) > 10
    assert {key.partition("_")[0] for key in [*components][7:]} == {"stopped"}
    assert [*json.loads(discovery(BASE, EVERYTHING, ("reboot",)))["cmps"]][6] == "reboot"
    assert {key for key, part in components.items() if part.get("ret")} == {"video"}
    assert "avty_t" not in components["presence"]
    assert [*json.loads(discovery(BASE, {}))["cmps"]] == ["presence"]


def test_what_it_sends_is_understood() -> None:
    components = json.loads(discovery(BASE, EVERYTHING))["cmps"]
    stop = re.sub(r"{{ '%016x' .+? }}", "00066171a4181e4e", components["stop"]["cmd_tpl"])
    assert stop_of(json.loads(stop)) == ("00066171a4181e4e", "homeassistant", "")
    light = re.sub(r"{{.+?}}", "0.5", components["light"]["cmd_on_tpl"])
    assert codec.decode(LIGHTS_SOLID, light.encode()) == LightsSolid(r=0.5, g=0.5, b=0.5)
    assert codec.decode(LIGHTS_SOLID, components["light"]["cmd_off_tpl"].encode()) == LightsSolid()


def test_with_names_all_commands_but_stop_have_one() -> None:
    components = json.loads(discovery(BASE, {**EVERYTHING, "named": True}, ("restart",)))["cmps"]
    commands = {
        key: part["cmd_t"].removeprefix(f"{BASE}/incoming/") for key, part in components.items() if "cmd_t" in part
    }
    assert commands == {
        "stop": "estop", "video": "by/homeassistant/flags/mqtt-video", "light": "by/homeassistant/lights-solid",
        "restart": "by/homeassistant/flags/service-restart",
    }  # fmt: skip
    assert components["video"]["ret"] is False  # nothing is retained there


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
    assert config.section(HomeAssistant).expose == ("restart",)
    assert facts(config).lines == (("home assistant", "homeassistant, buttons: stop, restart"),)
    assert object_id(config.base) in PAGE
    snippet["services"]["mqtt_bridge"]["enabled"] = False
    (warning,) = parse(snippet, folder=Path("/"), env={}).warnings
    assert warning.startswith("services.homeassistant.enabled: is not used without a remote broker by MQTT")
    snippet["services"]["homeassistant"] |= {"expose": ["drive"]}
    with pytest.raises(ConfigError, match=r"services\.homeassistant\.expose"):
        parse(snippet, folder=Path("/"), env={})
