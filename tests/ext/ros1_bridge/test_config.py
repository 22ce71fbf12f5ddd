"""The original's keys are read; what is done otherwise is said; and a robot without a base notices nothing."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from pebble.check_result import State
from pebble.config import load, parse
from pebble.errors import ConfigError
from pebble.extension import programs_of
from pebble.services.ros1_bridge.checks import checks
from pebble.services.ros1_bridge.config import Ros1
from tests.commands.conftest import Run
from tests.ext.ros1_bridge.conftest import World
from tests.support import ROOT, until

EXAMPLE = ROOT / "configs" / "husky.example.json"
ORIGINAL = json.loads((ROOT / "tests" / "data" / "original-shaped-config.json").read_text())


def read(section: dict[str, Any], robot: str = "husky") -> Any:
    return parse({"robot": {"id": robot}, "services": {"ros1_bridge": section}}, folder=Path("/"), env={})


def test_the_example_and_the_section_of_the_original_are_read_without_a_warning(run: Run) -> None:
    config = load(EXAMPLE, env={})
    assert (config.warnings, config.motor_owners) == ((), ("ros1",))
    assert run("check", str(EXAMPLE)) == 0
    section = ORIGINAL["services"]["ros1_bridge"] | {"enabled": True, "heartbeat": {"enabled": False}}
    config = read(section, "rover-7")
    ours, defaults = config.section(Ros1), Ros1()
    assert config.warnings == ()
    assert (ours.ros, ours.motion, ours.safety) == (defaults.ros, defaults.motion, defaults.safety)


@pytest.mark.parametrize(
    ("section", "said"),
    [
        ({"heartbeat": {"enabled": True}}, "heartbeat: is not sent a second time: mqtt_bridge sends it"),
        ({"safety": {"stop_on_shutdown": False}}, "safety.stop_on_shutdown: is not used"),
        ({"safety": {"drive_timeout_seconds": 0}}, "safety.drive_timeout_seconds: must be a number above 0"),
        ({"telemetry": {"diagnostics": {"retain": False}}}, "telemetry.diagnostics.retain: is not used: the contract"),
        ({"ros": {"host": "192.168.1.7"}}, "ros.host: is open to other machines, and ROS has no passwords"),
        ({"ros": {"master_uri": "http://base:11311"}}, "ros.master_uri: is another machine, and ROS has no passwords"),
    ],
)
def test_what_is_done_otherwise_is_a_warning(section: dict[str, Any], said: str) -> None:
    (warning, *_) = read({"enabled": True, **section}).warnings
    assert warning.startswith(f"services.ros1_bridge.{said}")
    assert read({"enabled": False, **section}).warnings == () or "safety" in said


@pytest.mark.parametrize(
    ("section", "said"),
    [
        ({"topics": {"drive_values": "a/b"}}, "topics.drive_values: must be pebble/robots/husky/incoming/drive-values"),
        ({"ros": {"estop_topic": "/cmd_vel"}}, "ros.estop_topic: is cmd_vel_topic, too"),
        ({"ros": {"master_uri": "base"}}, "ros.master_uri: must be the address of a ROS master"),
        ({"ros": {"node_name": "a b"}}, "ros.node_name: must be a name of ROS"),
    ],
)
def test_what_cannot_be_done_is_a_problem(section: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(f"services.ros1_bridge.{said}")):
        read({"enabled": True, **section})


def test_without_driving_the_robot_has_no_motors() -> None:
    for section, process, owners in (
        ({}, [], ()),
        ({"enabled": True}, ["ros1_bridge"], ("ros1",)),
        ({"enabled": True, "drive": {"enabled": False}}, ["ros1_reader"], ()),
    ):
        config = read(section)
        programs = [program.name for program in programs_of(config.installed, config) if "ros1" in program.module]
        assert (programs, config.motor_owners) == (process, owners)


def test_doctor_says_whether_anything_would_obey(ros: World) -> None:
    def states(uri: str, **more: Any) -> list[State]:
        return [result.state for result in checks(read({"enabled": True, "ros": {"master_uri": uri, **more}}))]

    assert until(lambda: states(ros.uri) == [State.OK])
    assert states(ros.uri, cmd_vel_topic="/nowhere") == [State.WARN]
    ros.kill("master")
    assert states(ros.uri) == [State.FAILED]
