"""The discovery message, by which Home Assistant shows a robot as a device; from its capabilities. Pure.

It never offers to move a robot or to end a stop: Home Assistant does not repeat commands, so it is no dead man's
switch.
"""

import re
from collections.abc import Collection, Iterator
from typing import Any, Final
from zlib import crc32

import msgspec

from pebble import contract as c
from pebble.contract.names import with_name
from pebble.extensions.operator.client.robot_topics import names, section_of, topic_of
from pebble.version import __version__

MAX_BYTES, MAX_COMPONENTS = 8000, 24  # of the message, and of what is in it; the last owners are left out
ACCOUNT: Final = "homeassistant"  # of Home Assistant at a broker that vouches for names
_STALE_S: Final = 600  # after it, volts are not shown
_OFFLINE: Final = "value_json.online is defined and not value_json.online"
_STOP: Final = """{"stop": "{{ '%016x' | format((now().timestamp() * 1000000) | int) }}", "by": "homeassistant"}"""
_COLOUR: Final = (
    '{"r": {{ (red | default(255)) / 255 }}, "g": {{ (green | default(255)) / 255 }}, '
    '"b": {{ (blue | default(255)) / 255 }}}'
)
_FLAG: Final = "{{ (value_json.value if value_json is mapping else value_json) | string | lower }}"
_DARK: Final = '{"r": 0, "g": 0, "b": 0}'
_BUTTONS: Final = {"restart": ("service_restart", c.SERVICE_RESTART), "reboot": ("reboot", c.REBOOT)}
_UNITS: Final = {"v": ("voltage", "V"), "%": ("battery", "%")}

Component = dict[str, Any]


def object_id(base: str) -> str:
    """Return a unique name of the robot that has only letters, digits and underscores or hyphens."""
    plain = base.replace("/", "_")
    allowed = re.sub(r"[^A-Za-z0-9_-]", "_", plain)
    exact = allowed == plain and base.count("_") == 0  # else two robots might have one name
    return f"pebble_{allowed}" if exact else f"pebble_{allowed}_{crc32(base.encode()):08x}"


def discovery(base: str, capabilities: dict[str, Any], expose: Collection[str] = (), unit: str = "") -> bytes:
    """Return the message. ``unit``: the unit of the battery's level, ``v`` or ``%``; "" if unknown."""
    name, identity = object_id(base), section_of(capabilities, "identity")
    online = c.ONLINE.topic(base)
    availability = {"avty_t": online, "avty_tpl": f"{{{{ 'offline' if {_OFFLINE} else 'online' }}}}"}
    components: dict[str, Component] = {}
    # Without availability: an absent tracker would be unavailable, not away.
    presence = {"p": "device_tracker", "name": "Presence", "stat_t": online, "src_type": "router"}
    components["presence"] = presence | {"val_tpl": f"{{{{ 'not_home' if {_OFFLINE} else 'home' }}}}"}
    components |= {key: value | availability for key, value in _components(base, capabilities, expose, unit)}
    for key, component in components.items():
        component["uniq_id"] = f"{name}_{key}"
    message = {
        "dev": {
            "ids": [name],
            "name": identity.get("name") or base.rpartition("/")[2],
            "mf": "Pebble",
            "mdl": identity.get("description") or base.split("/")[1],
            "sw": __version__,
        },
        "o": {"name": "pebble", "sw": __version__},
        "cmps": components,
    }
    while len(components) > MAX_COMPONENTS or len(msgspec.json.encode(message)) > MAX_BYTES:
        components.popitem()  # from the end, where the states of owners are
    return msgspec.json.encode(message)


def _components(
    base: str, capabilities: dict[str, Any], expose: Collection[str], unit: str
) -> Iterator[tuple[str, Component]]:
    """Yield the components by their keys, for what the capabilities offer and Home Assistant can show.

    ``expose``: the keys of `_BUTTONS` that may be offered. ``unit``: see `discovery`.
    """

    def topic(channel: c.Channel) -> str:
        return topic_of(base, capabilities, channel)

    named = capabilities.get("named") is True  # the topic of a command needs the name of its sender

    def command(where: str) -> Component:
        return {"cmd_t": with_name(where, ACCOUNT) if named else where, "qos": 1}

    estop, video = section_of(capabilities, "estop"), section_of(capabilities, "video")
    if estop.get("available") is True:  # it needs no name
        yield "stop", {"p": "button", "name": "STOP", "cmd_t": c.ESTOP.topic(base), "cmd_tpl": _STOP, "qos": 1}
    if unit in _UNITS:
        kind, sign = _UNITS[unit]
        level = {"p": "sensor", "name": "Battery", "dev_cla": kind, "unit_of_meas": sign, "exp_aft": _STALE_S}
        yield "battery", level | {"stat_t": topic(c.CHARGING_LEVEL), "val_tpl": "{{ value_json.value }}"}
    if section_of(capabilities, "telemetry").get("charging_status") is True:
        yield "charging", _binary("Charging", "battery_charging", topic(c.CHARGING_STATUS), "value")
    if video.get("encoding") == "jpeg":  # Home Assistant shows no other
        yield "camera", {"p": "camera", "name": "Camera", "t": topic(c.CAMERA)}
    if video.get("controls") is True:  # ret: the bridge drops a retained message on a topic with a name
        flag = {"p": "switch", "name": "Video", "stat_t": topic(c.MQTT_VIDEO), "val_tpl": _FLAG}
        yield "video", flag | {"pl_on": "true", "pl_off": "false"} | command(topic(c.MQTT_VIDEO)) | {"ret": not named}
    if section_of(capabilities, "lights").get("solid") is True:
        # Templates for a state that no topic has: without them Home Assistant offers no colours.
        unread = dict.fromkeys(("r_tpl", "g_tpl", "b_tpl"), "{{ 0 }}")
        light = {"p": "light", "name": "Light", "schema": "template", "cmd_on_tpl": _COLOUR, "cmd_off_tpl": _DARK}
        yield "light", light | unread | command(topic(c.LIGHTS_SOLID))
    for key, (section, channel) in _BUTTONS.items():
        offer = section_of(capabilities, f"system.{section}")
        if key in expose and offer.get("controls") is True:
            listed = offer.get("flag_topic")  # used only if it is the robot's, and no other channel's
            where = str(listed) if names(base, listed, channel) else channel.topic(base)
            button = {"p": "button", "name": key.capitalize(), "dev_cla": "restart", "pl_prs": "true"}
            yield key, button | command(where)
    owners = estop.get("owners")
    if isinstance(owners, list):
        for owner in owners:
            state = c.ESTOP_STATE.topic(base, owner=owner)
            yield f"stopped_{owner}", _binary(f"Stopped {owner}", "problem", state, "latched")


def _binary(name: str, kind: str, topic: str, field: str) -> Component:
    state = f"{{{{ 'ON' if value_json.{field} else 'OFF' }}}}"
    return {"p": "binary_sensor", "name": name, "dev_cla": kind, "stat_t": topic, "val_tpl": state}
