from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pebble.config import parse
from pebble.launcher.capabilities import capabilities
from pebble.runtime.addresses import Addresses

BASE = "pebble/robots/rover"
MOTOR = {"enabled": True, "serial": {"port": "/dev/ttyACM0"}}
BRIDGE = {"enabled": True, "remote_mqtt": {"host": "far"}}


def of(kind: str = "mqtt", **services: Any) -> dict[str, Any]:
    raw = {"robot": {"id": "rover"}, "transport": {"kind": kind}, "services": services}
    config = parse(raw, folder=Path("/robots"), env={})
    return capabilities(config, Addresses(config))


def test_people_see_it_as_its_config_describes_it() -> None:
    looks = {"name": "Goob", "description": "Rover", "colour": "blue", "picture": "goob", "battery_cells": 2}
    config = parse({"robot": {"id": "rover", **looks}}, folder=Path("/robots"), env={})
    assert capabilities(config, Addresses(config))["identity"] == {
        "system": "pebble",
        "type": "robots",
        "id": "rover",
        **looks,
    }


def test_a_robot_that_reads_names_lists_it() -> None:
    raw = {
        "robot": {"id": "rover"},
        "transport": {"kind": "zenoh"},
        "security": {"level": "named"},
        "services": {"mqtt_bridge": {"enabled": True, "remote_mqtt": {"host": "127.0.0.1"}}},
    }
    config = parse(raw, folder=Path("/robots"), env={})
    assert capabilities(config, Addresses(config))["named"] is True


def test_a_robot_without_services_still_lists_everything() -> None:
    assert of() == {
        "identity": {"system": "pebble", "type": "robots", "id": "rover"},
        "transport": {"kind": "mqtt"},
        "video": {
            "available": False,
            "controls": False,
            "topic": f"{BASE}/outgoing/front-camera",
            "command_topic": f"{BASE}/incoming/front-camera",
            "flag_topic": f"{BASE}/incoming/flags/mqtt-video",
            "overlays_topic": f"{BASE}/outgoing/video-overlays",
            "width": 640,
            "height": 480,
            "fps": 15,
            "encoding": "json",
            "encodings": ["json", "pbvd", "h264"],
        },
        "audio": {
            "available": False,
            "controls": False,
            "topic": f"{BASE}/outgoing/audio",
            "uplink_topic": f"{BASE}/incoming/audio-stream",
            "command_topic": f"{BASE}/incoming/audio",
            "flag_topic": f"{BASE}/incoming/flags/mqtt-audio",
            "rate": 16000,
            "channels": 1,
            "encoding": "pcm",
            "encodings": ["pcm", "opus"],
        },
        "soundboard": {
            "available": False,
            "controls": False,
            "command_topic": f"{BASE}/incoming/soundboard-command",
            "files_topic": f"{BASE}/outgoing/soundboard-files",
            "status_topic": f"{BASE}/outgoing/soundboard-status",
        },
        "autonomy": {
            "available": False,
            "controls": False,
            "command_topic": f"{BASE}/incoming/autonomy-command",
            "files_topic": f"{BASE}/outgoing/autonomy-files",
            "status_topic": f"{BASE}/outgoing/autonomy-status",
        },
        "system": {
            "reboot": {"available": True, "controls": False, "flag_topic": f"{BASE}/incoming/flags/reboot"},
            "service_restart": {
                "available": True,
                "controls": False,
                "flag_topic": f"{BASE}/incoming/flags/service-restart",
            },
            "git_pull": {"available": True, "controls": False, "flag_topic": f"{BASE}/incoming/flags/git-pull"},
        },
        "drive": {"available": False, "controls": False, "topic": f"{BASE}/incoming/drive-values"},
        "estop": {
            "available": False,
            "topic": f"{BASE}/incoming/estop",
            "reset_topic": f"{BASE}/incoming/estop-reset",
            "owners": [],
            "status_topics": [],
        },
        "lights": {
            "solid": False,
            "flash": False,
            "solid_topic": f"{BASE}/incoming/lights-solid",
            "flash_topic": f"{BASE}/incoming/lights-flash",
        },
        "telemetry": {
            "touch_sensors": False,
            "charging_status": False,
            "touch_topic": f"{BASE}/outgoing/touch-sensors",
            "charging_topic": f"{BASE}/outgoing/charging-status",
            "charging_level_topic": f"{BASE}/outgoing/charging-level",
            "wheel_odometry": False,
            "wheel_odometry_topic": f"{BASE}/outgoing/wheel-odometry",
            "imu": False,
            "imu_topic": f"{BASE}/outgoing/sensors/imu",
        },
        "outlets": {"available": False, "controls": False, "outlets": []},
    }


def test_what_processes_report_is_listed() -> None:
    config = parse({"robot": {"id": "rover"}}, folder=Path("/robots"), env={})
    found = {"outlets/o2/status", "outlets/o1/power", "outlets/o1/status"}
    value = capabilities(config, Addresses(config), found=found)
    o1 = {"status_topic": f"{BASE}/outgoing/outlets/o1/status", "command_topic": f"{BASE}/incoming/outlets/o1/power"}
    o2 = {"status_topic": f"{BASE}/outgoing/outlets/o2/status"}
    assert value["outlets"] == {
        "available": True,
        "controls": True,
        "outlets": [{"name": "o1", "controls": True, **o1}, {"name": "o2", "controls": False, **o2}],
    }


def test_the_transport_shows() -> None:
    assert of("zenoh")["transport"] == {"kind": "zenoh"}


def test_a_motor_line_offers_driving_lights_and_telemetry() -> None:
    value = of(serial_mcu_bridge=MOTOR)
    assert value["drive"]["available"]
    assert value["drive"]["controls"]
    assert value["drive"]["arbitrates"]
    assert value["drive"]["axes"] == ["x", "z"]
    assert value["estop"]["available"]
    assert value["estop"]["owners"] == ["serial"]
    assert value["estop"]["status_topics"] == [f"{BASE}/outgoing/estop/serial"]
    assert value["lights"]["solid"]
    assert value["lights"]["flash"]
    assert value["telemetry"]["charging_status"]
    assert not value["telemetry"]["touch_sensors"], "only when it is published"
    assert of(serial_mcu_bridge={**MOTOR, "telemetry": {"publish_touch_sensors": True}})["telemetry"]["touch_sensors"]


@pytest.mark.parametrize(
    ("instances", "there"),
    [
        ({"imu": {"protocol": "pebble_serial_v1"}}, True),
        ({"front": {"protocol": "imu_mpu6050_v1"}}, True),
        ({"outlets": {"protocol": "pebble_serial_v1"}}, False),
        ({"imu": {"protocol": "pebble_serial_v1", "enabled": False}}, False),
        ({"imu": {"protocol": "goob_base_v1"}}, False),
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


@pytest.mark.parametrize("name", ["reboot", "service_restart", "git_pull"])
def test_a_system_action_can_be_asked_for_where_a_command_is_set(name: str) -> None:
    control = {f"{name}_control": {"command": ["true"]}}
    system = of(mqtt_bridge={**BRIDGE, **control})["system"]
    assert [key for key, entry in system.items() if entry["controls"]] == [name]
    assert all(entry["available"] for entry in system.values())
    assert not of(mqtt_bridge={"enabled": False, **control})["system"][name]["controls"]


@pytest.mark.parametrize("enabled", [True, False])
def test_sounds_are_offered_where_the_soundboard_is_enabled(enabled: bool) -> None:
    soundboard = of(soundboard_handler={"enabled": enabled})["soundboard"]
    assert (soundboard["available"], soundboard["controls"]) == (enabled, enabled)


@pytest.mark.parametrize("enabled", [True, False])
def test_scripts_are_there_where_they_are_enabled(enabled: bool) -> None:
    value = of(autonomy_manager={"enabled": enabled})["autonomy"]
    assert (value["available"], value["controls"]) == (enabled, enabled)


@pytest.mark.parametrize(("section", "device"), [("video", "video"), ("audio", "audio")])
def test_pictures_and_sound_are_there_with_their_device_and_on_request_with_a_bridge(section: str, device: str) -> None:
    def offered(**services: Any) -> tuple[bool, bool]:
        value = of(**services)[section]
        return value["available"], value["controls"]

    on, off = {"enabled": True}, {"enabled": True, device: {"enabled": False}}
    assert offered(av_daemon=on, mqtt_bridge=BRIDGE) == (True, True)
    assert offered(av_daemon=on) == (True, False)
    assert offered(av_daemon=off, mqtt_bridge=BRIDGE) == (False, False)
    assert offered(av_daemon={"enabled": False}, mqtt_bridge=BRIDGE) == (False, False)


def test_encodings_are_those_of_this_installation(monkeypatch: pytest.MonkeyPatch) -> None:
    publishers = {"video_publisher": {"encoding": "pbvd"}, "audio_publisher": {"encoding": "opus"}}
    value = of(mqtt_bridge={"media": publishers})
    assert (value["video"]["encoding"], value["audio"]["encoding"]) == ("pbvd", "opus")
    monkeypatch.setattr("pebble.runtime.pyav.find_spec", lambda _name: None)
    value = of()
    assert (value["video"]["encodings"], value["audio"]["encodings"]) == (["json", "pbvd"], ["pcm"])


@pytest.mark.parametrize(
    ("publisher", "captured", "expected"),
    [
        ({}, {}, (640, 480, 15)),
        ({}, {"width": 1920, "height": 1080, "fps": 30}, (1920, 1080, 30)),
        ({"width": 800, "height": 600, "fps": 12}, {"width": 1920, "height": 1080, "fps": 30}, (800, 600, 12)),
        ({"width": 800, "publish_width": 320, "target_fps": 9, "fps": 12}, {}, (320, 480, 9)),
        ({"publish_fps": 5, "target_fps": 9, "publish_height": 240, "height": 1}, {}, (640, 240, 5)),
    ],
)
def test_picture_size_and_rate(publisher: Any, captured: Any, expected: tuple[int, int, float]) -> None:
    video = of(mqtt_bridge={"media": {"video_publisher": publisher}}, av_daemon={"video": captured})["video"]
    assert (video["width"], video["height"], video["fps"]) == expected


def test_sound_format() -> None:
    assert of(av_daemon={"audio": {"rate": 48000, "channels": 2}})["audio"]["rate"] == 48000
    audio = of(
        mqtt_bridge={"media": {"audio_publisher": {"rate": 8000}}}, av_daemon={"audio": {"rate": 48000, "channels": 2}}
    )["audio"]
    assert (audio["rate"], audio["channels"]) == (8000, 2)


#: Where a config renames a channel, and where capabilities show it.
OVERRIDES = [
    ("mqtt_bridge.topics.mqtt_audio", "audio.flag_topic"),
    ("mqtt_bridge.topics.mqtt_video", "video.flag_topic"),
    ("mqtt_bridge.topics.reboot", "system.reboot.flag_topic"),
    ("mqtt_bridge.topics.service_restart", "system.service_restart.flag_topic"),
    ("mqtt_bridge.topics.git_pull", "system.git_pull.flag_topic"),
    ("mqtt_bridge.topics.audio_control", "audio.command_topic"),
    ("mqtt_bridge.topics.video_control", "video.command_topic"),
    ("mqtt_bridge.media.video_publisher.topic", "video.topic"),
    ("mqtt_bridge.media.video_publisher.overlays_topic", "video.overlays_topic"),
    ("mqtt_bridge.media.audio_publisher.topic", "audio.topic"),
    ("mqtt_bridge.media.audio_receiver.topic", "audio.uplink_topic"),
    ("soundboard_handler.topics.command", "soundboard.command_topic"),
    ("soundboard_handler.topics.files", "soundboard.files_topic"),
    ("soundboard_handler.topics.status", "soundboard.status_topic"),
    ("autonomy_manager.topics.command", "autonomy.command_topic"),
    ("autonomy_manager.topics.files", "autonomy.files_topic"),
    ("autonomy_manager.topics.status", "autonomy.status_topic"),
    ("serial_mcu_bridge.topics.drive_values", "drive.topic"),
    ("serial_mcu_bridge.topics.lights_solid", "lights.solid_topic"),
    ("serial_mcu_bridge.topics.lights_flash", "lights.flash_topic"),
    ("serial_mcu_bridge.topics.touch_sensors", "telemetry.touch_topic"),
    ("serial_mcu_bridge.topics.charging_status", "telemetry.charging_topic"),
    ("serial_mcu_bridge.topics.charging_level", "telemetry.charging_level_topic"),
    ("serial_mcu_bridge.topics.low_rate", "telemetry.imu_topic"),
]


def nested(path: str, value: str) -> dict[str, Any]:
    tree: Any = value
    for key in reversed(path.split(".")):
        tree = {key: tree}
    result: dict[str, Any] = tree
    return result


def at(tree: Any, path: str) -> Any:
    for key in path.split("."):
        tree = tree[key]
    return tree


@pytest.mark.parametrize(("path", "shown"), OVERRIDES, ids=[path for path, _ in OVERRIDES])
def test_a_renamed_channel_is_advertised_under_its_new_name(path: str, shown: str) -> None:
    assert at(of(**nested(path, f"{BASE}/other/name")), shown) == f"{BASE}/other/name"
    assert at(of(), shown) != f"{BASE}/other/name"


def test_a_motor_that_is_an_instance_is_advertised_under_its_own_names() -> None:
    value = of(
        serial_mcu_bridge={
            "enabled": False,
            "topics": {"drive_values": f"{BASE}/incoming/of-the-root"},
            "instances": {"base": {**MOTOR, "topics": {"drive_values": f"{BASE}/incoming/of-the-instance"}}},
        }
    )
    assert value["drive"]["topic"] == f"{BASE}/incoming/of-the-instance"
    assert value["estop"]["owners"] == ["base"]


@pytest.mark.parametrize(
    ("services", "moves", "owners", "zeros"),
    [
        ({}, False, [], None),
        ({"ros1_bridge": {"enabled": False}}, False, [], None),
        ({"ros1_bridge": {"enabled": True, "drive": {"enabled": False}}}, False, [], None),
        ({"ros1_bridge": {"enabled": True}}, True, [], [f"{BASE}/incoming/drive-values"]),
        ({"ros1_bridge": {"enabled": True, "topics": {"drive_values": "a/b"}}}, True, [], ["a/b"]),
        ({"serial_mcu_bridge": MOTOR}, True, ["serial"], None),
        (
            {"serial_mcu_bridge": MOTOR, "ros1_bridge": {"enabled": True}},
            True,
            ["serial"],
            [f"{BASE}/incoming/drive-values"],
        ),
    ],
)
def test_what_ros_moves_drives_and_gets_zeros_at_a_stop(
    services: dict[str, Any], moves: bool, owners: list[str], zeros: list[str] | None
) -> None:
    value = of(**services)
    assert (value["drive"]["available"], value["estop"]["owners"], value["estop"].get("zeros")) == (
        moves,
        owners,
        zeros,
    )


def test_without_an_emergency_stop_no_owner_is_listed() -> None:
    wheels = {name: {"enabled": True, "serial": {"port": f"/dev/{name}"}} for name in ("left", "right")}
    raw = {"robot": {"id": "rover"}, "services": {"serial_mcu_bridge": {"instances": wheels}}}
    config = parse(raw, folder=Path("/robots"), env={})
    assert capabilities(config, Addresses(config))["estop"]["owners"] == ["left", "right"]
    value = capabilities(config, Addresses(config), {"estop"})
    assert value["estop"] == {
        "available": False,
        "topic": f"{BASE}/incoming/estop",
        "reset_topic": f"{BASE}/incoming/estop-reset",
        "owners": [],
        "status_topics": [],
    }
    assert value["drive"] == capabilities(config, Addresses(config))["drive"]


def test_a_foreign_streaming_program_can_be_asked_for() -> None:
    stream = {"enabled": True, "command": ["mediamtx"]}
    assert of(mqtt_bridge=BRIDGE, video_stream=stream)["video"]["controls"]
    assert not of(video_stream=stream)["video"]["available"]
