from __future__ import annotations

import json
from collections.abc import Collection
from pathlib import Path
from typing import Any

import pytest

from pebble.config import parse
from pebble.config.raw import deep_merge
from pebble.contract import CHANNELS
from pebble.launcher.capabilities import capabilities
from pebble.runtime.addresses import Addresses
from tests.kit import configs

BASE = "pebble/robots/rover"
MOTOR = {"enabled": True, "serial": {"port": "/dev/ttyACM0"}}
BRIDGE = {"enabled": True, "remote_mqtt": {"host": "far"}}
ON, OFF = {"enabled": True}, {"enabled": False}


def of(
    kind: str = "mqtt",
    *,
    robot: dict[str, Any] | None = None,
    level: str = "open",
    lacking: Collection[str] = (),
    found: Collection[str] = (),
    **services: Any,
) -> dict[str, Any]:
    raw = {"robot": {"id": "rover", **(robot or {})}, "transport": {"kind": kind}, "security": {"level": level}}
    config = parse({**raw, "services": services}, folder=Path("/robots"), env={})
    return capabilities(config, Addresses(config), lacking, found)


def at(tree: Any, path: str) -> Any:
    """Return the value at a path of keys; None if there is none."""
    for key in path.split("."):
        tree = tree.get(key)
    return tree


#: Of a robot without services: by part, its topics, and what else is listed.
PARTS: dict[str, tuple[str, dict[str, Any]]] = {
    "video": (
        "topic:outgoing/front-camera command_topic:incoming/front-camera flag_topic:incoming/flags/mqtt-video"
        " overlays_topic:outgoing/video-overlays",
        {"width": 640, "height": 480, "fps": 15, "encoding": "json", "encodings": ["json", "pbvd", "h264"]},
    ),
    "audio": (
        "topic:outgoing/audio uplink_topic:incoming/audio-stream command_topic:incoming/audio"
        " flag_topic:incoming/flags/mqtt-audio",
        {"rate": 16000, "channels": 1, "encoding": "pcm", "encodings": ["pcm", "opus"]},
    ),
    **{
        part: (
            f"command_topic:incoming/{part}-command files_topic:outgoing/{part}-files"
            f" status_topic:outgoing/{part}-status",
            {},
        )
        for part in ("soundboard", "autonomy")
    },
    "drive": ("topic:incoming/drive-values", {}),
    "estop": ("topic:incoming/estop reset_topic:incoming/estop-reset", {"owners": [], "status_topics": []}),
    "lights": (
        "solid_topic:incoming/lights-solid flash_topic:incoming/lights-flash", {"solid": False, "flash": False}
    ),
    "telemetry": (
        "touch_topic:outgoing/touch-sensors charging_topic:outgoing/charging-status"
        " charging_level_topic:outgoing/charging-level wheel_odometry_topic:outgoing/wheel-odometry"
        " imu_topic:outgoing/sensors/imu",
        dict.fromkeys(("touch_sensors", "charging_status", "wheel_odometry", "imu"), False),
    ),
    "outlets": ("", {"outlets": []}),
}  # fmt: skip


def test_a_robot_without_services_still_lists_everything() -> None:
    found, offered = of(), {"available": False, "controls": False}
    flags = {name: f"{BASE}/incoming/flags/{name.replace('_', '-')}" for name in found["system"]}
    assert found.pop("system") == {
        name: {"available": True, "controls": False, "flag_topic": flags[name]}
        for name in ("reboot", "service_restart", "git_pull")
    }
    assert found.pop("identity") == {"system": "pebble", "type": "robots", "id": "rover"}
    assert found.pop("transport") == {"kind": "mqtt"}
    for part, (topics, more) in PARTS.items():
        named = (topic.split(":") for topic in topics.split())
        state = {} if part in ("lights", "telemetry") else {"available": False} if part == "estop" else offered
        assert found.pop(part) == state | {name: f"{BASE}/{suffix}" for name, suffix in named} | more
    assert found == {}


LOOKS = {"name": "Goob", "description": "Rover", "colour": "blue", "picture": "goob", "battery_cells": 2}
MOVES = {"drive.available": True, "drive.controls": True}
LAMPS = {"name": "o1", "controls": True, "status_topic": f"{BASE}/outgoing/outlets/o1/status",
         "command_topic": f"{BASE}/incoming/outlets/o1/power"}  # fmt: skip
SENSOR = {"name": "o2", "controls": False, "status_topic": f"{BASE}/outgoing/outlets/o2/status"}
WHEELS = {"instances": {name: {"enabled": True, "serial": {"port": f"/dev/{name}"}} for name in ("left", "right")}}
ARM = {
    "enabled": False,
    "topics": {"drive_values": f"{BASE}/incoming/of-the-root"},
    "instances": {"base": {**MOTOR, "topics": {"drive_values": f"{BASE}/incoming/of-the-instance"}}},
}
STREAM = {"enabled": True, "command": ["mediamtx"]}
#: What a robot has, and what is listed of it.
OFFERS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "looks": ({"robot": LOOKS}, {"identity": {"system": "pebble", "type": "robots", "id": "rover", **LOOKS}}),
    "names that it reads": (
        {"level": "named", "kind": "zenoh", "mqtt_bridge": {"enabled": True, "remote_mqtt": {"host": "127.0.0.1"}}},
        {"named": True},
    ),
    "outlets that its processes report": (
        {"found": {"outlets/o2/status", "outlets/o1/power", "outlets/o1/status"}},
        {"outlets": {"available": True, "controls": True, "outlets": [LAMPS, SENSOR]}},
    ),
    "a motor line": (
        {"serial_mcu_bridge": MOTOR},
        {**MOVES, "drive.arbitrates": True, "drive.control": True, "drive.axes": ["x", "z"], "estop.available": True,
         "estop.owners": ["serial"], "estop.status_topics": [f"{BASE}/outgoing/estop/serial"], "lights.solid": True,
         "lights.flash": True, "telemetry.charging_status": True, "telemetry.touch_sensors": False},
    ),
    "no control": ({"serial_mcu_bridge": MOTOR, "lacking": {"control"}}, {**MOVES, "drive.control": None}),
    "odometry, with scripts": (
        {"serial_mcu_bridge": {**MOTOR, "telemetry": {"publish_touch_sensors": True}}, "autonomy_manager": ON},
        {"telemetry.touch_sensors": True, "telemetry.wheel_odometry": True},
    ),
    "a motor that is an instance": (
        {"serial_mcu_bridge": ARM}, {"drive.topic": f"{BASE}/incoming/of-the-instance", "estop.owners": ["base"]},
    ),
    "two motors": ({"serial_mcu_bridge": WHEELS}, {**MOVES, "estop.owners": ["left", "right"]}),
    "no emergency stop": (
        {"serial_mcu_bridge": WHEELS, "lacking": {"estop"}},
        {**MOVES, "estop": {"available": False, "topic": f"{BASE}/incoming/estop", "owners": [], "status_topics": [],
                            "reset_topic": f"{BASE}/incoming/estop-reset"}},
    ),
    "ROS": ({"ros1_bridge": OFF}, {"drive.available": False}),
    "ROS that drives": (
        {"ros1_bridge": ON},
        {**MOVES, "drive.arbitrates": True, "drive.axes": ["x", "z"], "estop.owners": ["ros1"], "lights.solid": False,
         "telemetry.wheel_odometry": True, "telemetry.charging_status": False},
    ),
    "scripts": ({"autonomy_manager": ON}, {"autonomy.available": True, "autonomy.controls": True}),
    "camera and microphone": (
        {"av_daemon": ON},
        {"video.available": True, "video.controls": False, "audio.available": True, "audio.controls": False},
    ),
    "and a bridge that requests them": (
        {"av_daemon": ON, "mqtt_bridge": BRIDGE}, {"video.controls": True, "audio.controls": True},
    ),
    "a foreign streaming program": (
        {"mqtt_bridge": BRIDGE, "video_stream": STREAM}, {"video.available": True, "video.controls": True},
    ),
    "encodings": (
        {"mqtt_bridge": {"media": {"video_publisher": {"encoding": "pbvd"}, "audio_publisher": {"encoding": "opus"}}}},
        {"video.encoding": "pbvd", "audio.encoding": "opus"},
    ),
    "sound as it is published": (
        {"av_daemon": {"audio": {"rate": 48000, "channels": 2}},
         "mqtt_bridge": {"media": {"audio_publisher": {"rate": 8000}}}},
        {"audio.rate": 8000, "audio.channels": 2},
    ),
}  # fmt: skip


@pytest.mark.parametrize(("robot", "listed"), OFFERS.values(), ids=OFFERS)
def test_parts_of_a_robot_are_listed(robot: dict[str, Any], listed: dict[str, Any]) -> None:
    value = of(**robot)
    assert {path: at(value, path) for path in listed} == listed


@pytest.mark.parametrize(
    ("instances", "there"),
    [
        ({"imu": {"protocol": "pebble_serial_v1"}}, True),
        ({"outlets": {"protocol": "pebble_serial_v1"}}, False),
        ({"imu": {"protocol": "pebble_serial_v1", "enabled": False}}, False),
    ],
)
def test_an_inertial_sensor_is_listed_under_its_lines_own_name(instances: dict[str, Any], there: bool) -> None:
    topic = f"{BASE}/outgoing/sensors/rear"
    lines = {
        name: {"enabled": True, "serial": {"port": "/dev/imu"}, "topics": {"low_rate": topic}, **line}
        for name, line in instances.items()
    }
    telemetry = of(serial_mcu_bridge={**MOTOR, "instances": lines})["telemetry"]
    assert telemetry["imu"] is there
    assert telemetry["imu_topic"] == (topic if there else f"{BASE}/outgoing/sensors/imu")
    assert telemetry["charging_status"], "the motor's line is still told"


def test_a_system_action_can_be_asked_for_where_a_command_is_set() -> None:
    control = {"git_pull_control": {"command": ["true"]}}
    system = of(mqtt_bridge={**BRIDGE, **control})["system"]
    assert [key for key, entry in system.items() if entry["controls"]] == ["git_pull"]
    assert all(entry["available"] for entry in system.values())
    assert not of(mqtt_bridge={"enabled": False, **control})["system"]["git_pull"]["controls"]


def test_encodings_are_those_of_this_installation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pebble.extensions.media.pyav.find_spec", lambda _name: None)
    value = of()
    assert (value["video"]["encodings"], value["audio"]["encodings"]) == (["json", "pbvd"], ["pcm"])


@pytest.mark.parametrize(
    ("publisher", "captured", "expected"),
    [
        ({}, {}, (640, 480, 15)),
        ({"width": 800, "height": 600, "fps": 12}, {"width": 1920, "height": 1080, "fps": 30}, (800, 600, 12)),
        ({"width": 800, "publish_width": 320, "target_fps": 9, "fps": 12}, {}, (320, 480, 9)),
        ({"publish_fps": 5, "target_fps": 9, "publish_height": 240, "height": 1}, {}, (640, 240, 5)),
    ],
)
def test_picture_size_and_rate(publisher: Any, captured: Any, expected: tuple[int, int, float]) -> None:
    video = of(mqtt_bridge={"media": {"video_publisher": publisher}}, av_daemon={"video": captured})["video"]
    assert (video["width"], video["height"], video["fps"]) == expected


def test_a_renamed_channel_is_advertised_under_its_new_name() -> None:
    renamed: dict[str, Any] = {}
    expected = json.dumps(of())
    for channel in CHANNELS:
        if channel.override is not None:
            renamed = deep_merge(renamed, configs.at(channel.override, f"site/{channel.suffix}"))
            expected = expected.replace(f'"{BASE}/{channel.suffix}"', f'"site/{channel.suffix}"')
    assert of(**renamed["services"]) == json.loads(expected)
    assert expected.count('"site/') == 24
