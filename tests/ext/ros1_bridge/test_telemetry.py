"""The original's keys are read; messages of ROS become its payloads, and what is damaged ends nothing."""

from __future__ import annotations

import json
import math
import re
import socket
import struct
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pebble import contract as c
from pebble.check_result import State
from pebble.config import load, parse
from pebble.contract.payloads import WheelOdometry
from pebble.errors import ConfigError
from pebble.extension import programs_of
from pebble.extensions.checks.conform.motion import moves_until
from pebble.services.ros1_bridge import messages, publication
from pebble.services.ros1_bridge.checks import checks
from pebble.services.ros1_bridge.config import Ros1
from pebble.services.ros1_bridge.messages import Form
from pebble.services.ros1_bridge.publication import Publication, Subscriber
from pebble.services.ros1_bridge.telemetry import Telemetry
from pebble.services.ros1_bridge.wire import Blocks, RosError, block, pack_header, parse_header
from pebble.transports.counters import Counters
from tests.commands.conftest import Run
from tests.ext.ros1_bridge.conftest import World
from tests.ext.ros1_bridge.scripted import text
from tests.support import ROOT, until

EXAMPLE = ROOT / "configs" / "husky.example.json"
ORIGINAL = json.loads((ROOT / "tests" / "data" / "original-shaped-config.json").read_text())


def read(section: dict[str, Any], robot: str = "husky") -> Any:
    return parse({"robot": {"id": robot}, "services": {"ros1_bridge": section}}, folder=Path("/"), env={})


def test_the_example_and_the_section_of_the_original_are_read(run: Run) -> None:
    config = load(EXAMPLE, env={})
    assert (config.warnings, config.motor_owners) == ((), ("ros1",))
    assert run("check", str(EXAMPLE)) == 0
    config = read(ORIGINAL["services"]["ros1_bridge"] | {"enabled": True}, "rover-7")
    ours, defaults = config.section(Ros1), Ros1()
    (gone,) = config.warnings
    assert all(key in gone for key in ("log_level", "topics", "heartbeat", "stop_on_shutdown", "charging_level.qos"))
    assert (ours.ros, ours.motion, ours.safety) == (defaults.ros, defaults.motion, defaults.safety)


@pytest.mark.parametrize(
    ("section", "said"),
    [
        ({"ros": {"host": "192.168.1.7"}}, "ros.host: is open to other machines, and ROS has no passwords"),
        ({"ros": {"master_uri": "http://base:11311"}}, "ros.master_uri: is another machine, and ROS has no passwords"),
        ({"telemetry": {"diagnostics": {"retain": False}}}, "telemetry.diagnostics.retain: no longer used"),
        ({"safety": {"drive_timeout_seconds": 0}}, "safety.drive_timeout_seconds: must be a number above 0"),
    ],
)
def test_what_is_open_wrong_or_not_used_is_a_warning(section: dict[str, Any], said: str) -> None:
    (warning, *_) = read({"enabled": True, **section}).warnings
    assert warning.startswith(f"services.ros1_bridge.{said}")
    assert read({"enabled": False, **section}).warnings == () or not said.startswith("ros")


@pytest.mark.parametrize(
    ("section", "said"),
    [
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


# -- messages


class Heard:
    """In place of a node: what telemetry subscribes to, and what it publishes."""

    def __init__(self, **metrics: Any) -> None:
        raw = {"robot": {"id": "husky"}, "services": {"ros1_bridge": {"enabled": True, "telemetry": metrics}}}
        section = parse(raw, folder=Path("/"), env={}).section(Ros1)
        self.topics: dict[str, Callable[[bytes], None]] = {}
        self.published: dict[str, Any] = {}
        self.counters, self.odometry = Counters(), 0
        self.telemetry = Telemetry(self, section, self._publish, self.counters, self._hear)  # type: ignore[arg-type]

    def subscribe(self, topic: str, _form: Form, receive: Callable[[bytes], None]) -> None:
        self.topics[topic] = receive

    def _publish(self, channel: Any, payload: dict[str, Any]) -> None:
        self.published[channel.metric] = payload

    def _hear(self) -> None:
        self.odometry += 1


def stamped(frame: str = "odom", seconds: int = 1_700_000_000) -> bytes:
    return struct.pack("<III", 7, seconds, 500_000_000) + text(frame)


def odometry(x: float = 1.5) -> bytes:
    pose = struct.pack("<7d", x, -0.5, 0.1, 0.0, 0.0, math.sin(0.5), math.cos(0.5)) + bytes(288)
    return stamped() + text("base_link") + pose + struct.pack("<6d", 0.25, 0, 0, 0, 0, -0.125) + bytes(288)


def diagnostics(*parts: tuple[int, str, dict[str, str]]) -> bytes:
    body = stamped("") + struct.pack("<I", len(parts))
    for level, name, values in parts:
        body += struct.pack("<b", level) + text(name) + text("fine") + text("") + struct.pack("<I", len(values))
        body += b"".join(text(key) + text(value) for key, value in values.items())
    return body


def goals(*codes: int) -> bytes:
    parts = [bytes(8) + text(f"g{code}") + struct.pack("<B", code) + text("so") for code in codes]
    return stamped("") + struct.pack("<I", len(parts)) + b"".join(parts)


def path(count: int) -> bytes:
    points = [stamped("map") + struct.pack("<7d", number, 0, 0, 0, 0, 0, 1) for number in range(count)]
    return stamped("map") + struct.pack("<I", count) + b"".join(points)


STAMP = {"timestamp": 1_700_000_000.5}
BATTERY = "/Jackal Base/General/Battery"


def test_odometry_is_published_twice_and_noted_always() -> None:
    heard = Heard()
    for _ in range(3):
        heard.topics["/odometry/filtered"](odometry())
    assert heard.odometry == 3
    assert heard.published["wheel-odometry"] == STAMP | {
        "unit": "mm", "source": "ros-odometry",
        "value": {"x_mm": 1500.0, "y_mm": -500.0, "heading_rad": 1.0, "heading_deg": 57.296, "linear_speed_mps": 0.25,
                  "angular_speed_radps": -0.125},
    }  # fmt: skip
    assert heard.published["localization-pose"] == STAMP | {
        "frame_id": "odom", "child_frame_id": "base_link", "source": "/odometry/filtered",
        "value": {"x_m": 1.5, "y_m": -0.5, "z_m": 0.1, "yaw_rad": 1.0, "yaw_deg": 57.296, "linear_velocity_mps": 0.25,
                  "angular_velocity_radps": -0.125},
    }  # fmt: skip


@pytest.mark.parametrize(
    ("codes", "value", "navigates"),
    [
        ((), (False, 0, -1, "UNKNOWN", "", ""), False),
        ((3, 1, 0), (True, 3, 1, "ACTIVE", "g1", "so"), True),
        ((4, 3), (False, 2, 3, "SUCCEEDED", "g3", "so"), False),
    ],
)
def test_the_first_active_goal_is_told_else_the_last(codes: tuple[int, ...], value: Any, navigates: bool) -> None:
    heard = Heard()
    heard.topics["/move_base/current_goal"](stamped("map") + struct.pack("<7d", 1, 2, 0, 0, 0, 0, 1))
    goal = heard.published["navigation-goal"]["value"]
    assert goal | {"orientation": 0} == {
        "frame_id": "map", "x_m": 1.0, "y_m": 2.0, "z_m": 0.0, "yaw_rad": 0.0, "yaw_deg": 0.0, "orientation": 0,
    }  # fmt: skip
    heard.topics["/move_base/status"](goals(*codes))
    names = ("active", "goal_count", "code", "label", "goal_id", "text")
    told = dict(zip(names, value, strict=True)) | {"goal": goal}
    assert heard.published["navigation-status"]["value"] == told
    assert heard.telemetry.navigates is navigates


def test_plans_are_sampled_evenly_with_both_ends() -> None:
    heard = Heard(navigation_local_plan={"enabled": True, "max_points": 4})
    heard.topics["/move_base/TrajectoryPlannerROS/local_plan"](path(100))
    value = heard.published["navigation/local-plan"]["value"]
    assert (value["point_count"], value["sampled_point_count"]) == (100, 4)
    assert [point["x_m"] for point in value["points"]] == [0, 33, 66, 99]
    assert "/move_base/NavfnROS/plan" not in heard.topics, "it is off"
    for count in (0, 1):
        heard = Heard(navigation_local_plan={"enabled": True})
        heard.topics["/move_base/TrajectoryPlannerROS/local_plan"](path(count))
        assert len(heard.published["navigation/local-plan"]["value"]["points"]) == count


def test_diagnostics_tell_the_unhealthy_and_the_battery() -> None:
    heard = Heard(
        diagnostics={"max_items": 2},
        charging_status={"enabled": True, "status_name": "dock", "key": "on"},
        charging_level={"status_name": "power", "key": "Charge (%)"},
    )
    parts = [(0, "a", {}), (0, "b", {}), (0, "power", {"Charge (%)": "87.5"}), (2, "dock", {"on": " Charging "})]
    heard.topics["/diagnostics_agg"](diagnostics(*parts))
    value = heard.published["diagnostics"]["value"]
    assert (value["level"], value["label"], [item["name"] for item in value["items"]]) == (2, "ERROR", ["dock", "a"])
    assert heard.published["charging-level"] == STAMP | {"value": 87.5, "unit": "%"}
    assert heard.published["charging-status"] == STAMP | {"value": True}
    heard = Heard()
    for volts in ("27.5", "27.4"):
        heard.topics["/diagnostics_agg"](diagnostics((0, BATTERY, {"Battery Voltage (V)": volts})))
    assert heard.published["charging-level"] == STAMP | {"value": 27.5, "unit": "v"}, "once a second at most"


@pytest.mark.parametrize(
    ("topic", "body"),
    [
        ("/odometry/filtered", odometry()[:-300]),
        ("/odometry/filtered", odometry(x=math.nan)),
        ("/move_base/status", stamped("") + b"\xff\xff\xff\xff"),
        ("/diagnostics_agg", diagnostics((0, BATTERY, {"Battery Voltage (V)": "nan"}))),
    ],
)
def test_what_is_damaged_or_not_finite_is_counted_and_not_published(topic: str, body: bytes) -> None:
    heard = Heard()
    heard.topics[topic](body)
    assert heard.counters["ros_unread"] == 1
    assert not heard.published.keys() - {"diagnostics"}


def test_no_message_ends_anything() -> None:
    heard = Heard(navigation_local_plan={"enabled": True})

    @given(st.binary(max_size=400))
    def receive(body: bytes) -> None:
        for take in heard.topics.values():
            take(body)

    receive()


@given(st.lists(st.binary(max_size=50), max_size=5), st.integers(1, 20))
def test_blocks_are_cut_wherever_they_arrive(bodies: list[bytes], size: int) -> None:
    stream, blocks = b"".join(map(block, bodies)), Blocks(50)
    chunks = [stream[at : at + size] for at in range(0, len(stream), size)]
    assert [body for chunk in chunks for body in blocks.feed(chunk)] == bodies


def test_what_is_too_long_or_no_number_is_refused_and_a_damaged_header_has_no_fields() -> None:
    assert messages.twist(0.5, -1.25) == struct.pack("<6d", 0.5, 0, 0, 0, 0, -1.25)
    for number in (math.nan, math.inf, -math.inf):
        with pytest.raises(ValueError, match="finite"):
            messages.twist(number, 0.0)
    with pytest.raises(RosError, match="300 bytes"):
        Blocks(299).feed(struct.pack("<I", 300))
    assert parse_header(pack_header(topic="/a", md5sum="*")[4:]) == {"topic": "/a", "md5sum": "*"}
    assert parse_header(b"\xff\xff\xff\xfftopic=/a") == {"topic": "/a"}


def test_what_a_subscriber_cannot_take_is_dropped_and_one_that_takes_nothing_is_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Rule 7. What the kernel holds back is little, and lost with the connection after half a second."""
    now, closed = [100.0], []
    monkeypatch.setattr(publication.time, "monotonic", lambda: now[0])
    listener = socket.create_server(("127.0.0.1", 0))
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
    theirs = socket.create_connection(listener.getsockname())
    ours, _ = listener.accept()
    theirs.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
    topic = Publication("/cmd_vel", messages.TWIST, "", closed.append)
    subscriber = Subscriber(ours)
    assert ours.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 500
    assert ours.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF) <= 2 * 2304, "the kernel doubles it"
    topic.first = lambda: bytes(48)
    assert topic.add(subscriber)
    body = bytes(range(48))
    for _ in range(100_000):
        if not topic.send(body):
            break
    assert (topic.dropped, closed) == (1, [])
    now[0] += 1.01
    assert topic.send(body) == 0
    assert (closed, topic.names) == ([ours], set())
    received, blocks = theirs.recv(1 << 20), Blocks(48)
    assert blocks.feed(received)[:2] == [bytes(48), body], "first the first one, and whole messages"
    for sock in (listener, theirs, ours):
        sock.close()


def test_conform_sees_by_odometry_whether_a_base_moves() -> None:
    def seen(*speeds: tuple[float, float]) -> Any:
        values = [{"linear_speed_mps": ahead, "angular_speed_radps": turn} for ahead, turn in speeds]
        payloads = [WheelOdometry(value=value, timestamp=0.0) for value in values]
        records = [SimpleNamespace(at=at + 1.0, value=payload) for at, payload in enumerate(payloads)]
        return SimpleNamespace(of=lambda channel: records if channel is c.WHEEL_ODOMETRY else [], eyes=list)

    driven = seen((0.0, 0.0), (0.3, 0.0), (0.0, -0.5), (0.001, 0.001))
    assert [moves_until(driven, since) for since in (0.0, 3.5)] == [3.0, 0.0]
    assert moves_until(seen(), 0.0) is None
