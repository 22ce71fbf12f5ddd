"""What a robot says of itself: what it has, what its processes lack, and whether it can be driven."""

from __future__ import annotations

import json
import os
import re
import signal
import time
from collections.abc import Collection
from pathlib import Path
from typing import Any, cast

import pytest

from pebble.config import parse
from pebble.config.raw import deep_merge
from pebble.contract import CHANNELS
from pebble.launcher.capabilities import capabilities
from pebble.launcher.driveable import Driveable
from pebble.launcher.features import Features
from pebble.runtime import notes
from pebble.runtime.addresses import Addresses
from pebble.runtime.notes import Feature, Local, Mcu, Note, Reach
from tests.kit import configs
from tests.launcher.conftest import CONNECTION, Launch
from tests.support import until

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
REAR = {"serial": {"port": "/dev/imu"}, "topics": {"low_rate": f"{BASE}/outgoing/sensors/rear"},
        "protocol": "pebble_serial_v1"}  # fmt: skip
PULL, STREAM = {"command": ["true"]}, {"enabled": True, "command": ["mediamtx"]}
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
    "an inertial sensor, and outlets": (
        {"serial_mcu_bridge": {**MOTOR, "instances": {"imu": REAR, "outlets": {**REAR, "serial": {"port": "/dev/o"}}}}},
        {"telemetry.imu": True, "telemetry.imu_topic": f"{BASE}/outgoing/sensors/rear",
         "telemetry.charging_status": True},
    ),
    "no inertial sensor": (
        {"serial_mcu_bridge": {**MOTOR, "instances": {"outlets": REAR, "imu": {**REAR, **OFF}}}},
        {"telemetry.imu": False, "telemetry.imu_topic": f"{BASE}/outgoing/sensors/imu"},
    ),
    "an action whose command is set": (
        {"mqtt_bridge": {**BRIDGE, "git_pull_control": PULL}},
        {"system.git_pull.controls": True, "system.reboot.controls": False, "system.reboot.available": True},
    ),
    "an action without a bridge": (
        {"mqtt_bridge": {**OFF, "git_pull_control": PULL}}, {"system.git_pull.controls": False},
    ),
    "two motors": ({"serial_mcu_bridge": WHEELS}, {**MOVES, "estop.owners": ["left", "right"]}),
    "no emergency stop": (
        {"serial_mcu_bridge": WHEELS, "lacking": {"estop"}},
        {**MOVES, "estop": {"available": False, "topic": f"{BASE}/incoming/estop", "owners": [], "status_topics": [],
                            "reset_topic": f"{BASE}/incoming/estop-reset"}},
    ),
    "ROS that drives": (
        {"ros1_bridge": ON},
        {**MOVES, "drive.arbitrates": True, "drive.axes": ["x", "z"], "estop.owners": ["ros1"], "lights.solid": False,
         "telemetry.wheel_odometry": True, "telemetry.charging_status": False},
    ),
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


OWNER, UPLINK = "serial_mcu_bridge", "mqtt_bridge"
READY = {OWNER: "ready", UPLINK: "ready"}
WELL = {
    "link of the owner": (OWNER, Local(True)),
    "link of the bridge": (UPLINK, Local(True)),
    "reach": (UPLINK, Reach("serial", True)),
    "board": (OWNER, Mcu("ready", 0)),
}
#: What is different, and what follows.
CASES = {
    "all is well": ({}, "yes"),
    "port": ({"board": (OWNER, Mcu("absent", None, "no /dev/ttyACM0"))}, "no serial: no /dev/ttyACM0"),
    "stopped sending": (
        {"board": (OWNER, Mcu("silent", 10000))},
        "no serial: its board has stopped sending: it hangs, or has lost its power",
    ),
    "starts again and again": (
        {"board": (OWNER, Mcu("ready", 0, "", 3))},
        "unknown serial: its board has started again 3 times within a minute",
    ),
    "started again twice": ({"board": (OWNER, Mcu("ready", 0, "", 2))}, "yes"),
    "booting": ({"board": (OWNER, Mcu("booting", None))}, "unknown serial: its board is starting"),
    "never heard": ({"board": (OWNER, Mcu("ready", None))}, "unknown serial: its board has sent nothing yet"),
    "silent by design": (
        {"board": (OWNER, Mcu("ready", 10000))},
        "unknown serial: its board has sent nothing for 10 s",
    ),
    "line not reported": ({"board": None}, "unknown serial: it has just started"),
    "owner cut off": ({"link of the owner": (OWNER, Local(False, "no hub"))}, "no serial_mcu_bridge: no hub"),
    "bridge cut off": (
        {"link of the bridge": (UPLINK, Local(False))},
        "no mqtt_bridge: it does not reach the other programs",
    ),
    "link not reported": ({"link of the bridge": None}, "unknown mqtt_bridge has just started"),
    "siblings apart": ({"reach": (UPLINK, Reach("serial", False))}, "no mqtt_bridge receives nothing from serial"),
    "reach not reported": ({"reach": None}, "unknown mqtt_bridge has received nothing from serial yet"),
    "the worst counts": (
        {"board": (OWNER, Mcu("booting", None)), "reach": (UPLINK, Reach("serial", False))},
        "no mqtt_bridge receives nothing from serial",
    ),
}


class Assessed(Driveable):
    """A motor line behind the bridge, and an inertial sensor; counts how often the status had to follow."""

    def __init__(self) -> None:
        lines = {OWNER: "serial", f"{OWNER}:imu": "imu"}
        super().__init__(lines, [OWNER], [UPLINK], self._count)
        self.changes = 0

    def _count(self) -> None:
        self.changes += 1

    def receive(self, program: str, note: Note) -> None:
        """Hand the note to its handler, as the launcher does."""
        getattr(self, type(note).__name__.lower())(program, note)

    def shows(self, states: dict[str, str] | None = None) -> str:
        return " ".join((self.assessment(READY if states is None else states) or {}).values())


@pytest.mark.parametrize(("different", "expected"), CASES.values(), ids=CASES)
def test_the_worst_that_is_known_decides(different: dict[str, tuple[str, Note] | None], expected: str) -> None:
    robot = Assessed()
    for note in {**WELL, **different}.values():
        if note is not None:
            robot.receive(*note)
    assert robot.shows() == expected


@pytest.mark.parametrize(("program", "state"), [(OWNER, "init"), (UPLINK, "restarting"), (OWNER, "stopped")])
def test_a_process_that_is_not_ready_drives_nothing(program: str, state: str) -> None:
    robot = Assessed()
    for note in WELL.values():
        robot.receive(*note)
    assert robot.shows({**READY, program: state}).startswith(f"no {program} is ")


def test_reports_of_a_process_end_with_it() -> None:
    robot = Assessed()
    for note in WELL.values():
        robot.receive(*note)
    assert robot.mcus == {"serial": {"state": "ready", "heard_ms": 0}}
    assert robot.changes == len(WELL), "each is published"
    robot.ended(OWNER)
    assert robot.mcus == {}
    assert robot.shows() == "unknown serial_mcu_bridge has just started"


def test_the_age_of_what_was_received_is_not_published_by_itself() -> None:
    robot, counts = Assessed(), []
    for age in (None, 0, 1000, 0, 1000, 10000, 0):
        robot.receive(OWNER, Mcu("ready", age))
        counts.append(robot.changes)
    assert counts == [1, 2, 2, 2, 2, 3, 4]


def test_unknown_names_are_ignored() -> None:
    robot = Assessed()
    robot.receive("other", Mcu("ready", 0))
    robot.receive(UPLINK, Reach("other", True))
    assert (robot.mcus, robot.changes) == ({}, 0)


#: Who lacks (-) or has (+) a feature or ends (.), and what is lacking and found after each change.
HISTORIES: dict[str, tuple[str, list[set[str]]]] = {
    "lacking while any lacks it": ("l-estop l-estop r-estop l+estop other+estop r+estop", [{"-estop"}, set()]),
    "the end of a process": ("l-estop r. l.", [{"-estop"}, set()]),
    "found while any has it": ("a-outlets/o/power a+outlets/o/power b+outlets/o/power a-outlets/o/power b.",
                               [{"+outlets/o/power"}, set()]),
    "what is lacked is not found": ("a-outlets/o/power", []),
}  # fmt: skip


@pytest.mark.parametrize(("history", "changes"), HISTORIES.values(), ids=HISTORIES)
def test_reports_of_processes_are_merged(history: str, changes: list[set[str]]) -> None:
    seen: list[set[str]] = []

    def changed() -> None:
        seen.append({f"-{name}" for name in features.lacking} | {f"+{name}" for name in features.found})

    features = Features(changed)
    for program, mark, name in re.findall(r"(\w+)([-+.])(\S*)", history):
        if mark == ".":
            features.ended(program)
        else:
            features.receive(program, Feature(name, mark == "+"))
    assert seen == changes


def test_an_outlet_may_have_any_name_and_there_are_limits() -> None:
    features = Features(lambda: None)
    for name in ("Küche 1/power", *(f"{number}/status" for number in range(300))):
        features.receive("a", cast(Feature, notes.decode(notes.encode(Feature(f"outlets/{name}", True)))))
    assert len(features.found) == 256


def test_a_launcher_that_is_switched_off_publishes_none(launch: Launch) -> None:
    robot = launch(("motors", "asker", CONNECTION), enabled=False)
    assert robot.ready("motors")
    robot.order("motors", "lacks estop", "lacks nothing")
    assert until(lambda: "motors wrote what is no note" in robot.stderr())
    time.sleep(0.3)  # changes so close together are published together
    assert not robot.published("capabilities")


def test_capabilities_are_published_again_when_a_process_reports_and_when_it_ends(launch: Launch) -> None:
    robot = launch(("motors", "asker", CONNECTION))
    assert robot.ready("motors")
    assert len(robot.published("capabilities")) == 1
    robot.order("motors", "lacks estop", "lacks nothing")
    assert until(lambda: len(robot.published("capabilities")) == 2)
    os.kill(robot.events("motors", "start")[0], signal.SIGKILL)
    assert until(lambda: len(robot.published("capabilities")) == 3)
    assert "motors wrote what is no note, ignored: " in robot.stderr()
