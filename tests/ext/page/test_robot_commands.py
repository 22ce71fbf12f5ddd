"""What pages ask of robots besides driving: what is published, on which topic, and what is refused."""

from __future__ import annotations

import json
import time
from types import SimpleNamespace
from typing import Any

import httpx
import msgspec
import pytest

from pebble.contract import ESTOP, ESTOP_STATE
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.extensions.page import messages as m
from pebble.extensions.page import robot_commands
from pebble.extensions.page.drive.refusals import Refusals
from pebble.extensions.page.robots import Robots
from pebble.transports import Message, MqttSettings, QoS, create
from tests.ext.operator.client.estop_robot import Robot
from tests.ext.page.served import Page, Served
from tests.kit.played_robot import RecordingRobot
from tests.support import Broker, until

BASE = "pebble/robots/goob"
_decoder = msgspec.json.Decoder(m.FromPage)


def command(**fields: Any) -> Any:
    """Return the command as the server reads it."""
    return _decoder.decode(json.dumps({"ref": BASE, **fields}))


MANY = {"a": 1, "b": 0.5, "c": True, "d": "x", "e": None}
_HORN = {"action": "play", "enabled": True}
# fmt: off
#: What a page sends, and what is published below the robot's ``incoming/``: metric, and value. Flags are retained.
PUBLISHED: list[tuple[dict[str, Any], str, Any]] = [
    ({"op": "lights", "r": 1, "g": 0.5}, "lights-solid", {"b": 0.0, "g": 0.5, "r": 1.0}),
    ({"op": "lights", "b": 1, "period": 0.5}, "lights-flash", {"b": 1.0, "g": 0.0, "r": 0.0, "period": 0.5}),
    ({"op": "lights"}, "lights-solid", {"b": 0.0, "g": 0.0, "r": 0.0}),
    ({"op": "soundboard", "file": "a/horn.wav"}, "soundboard-command", {**_HORN, "file": "a/horn.wav"}),
    ({"op": "soundboard", "file": "horn.wav", "repeat": True}, "soundboard-command",
     {**_HORN, "file": "horn.wav", "repeat": True}),
    ({"op": "soundboard", "file": ""}, "soundboard-command", {"action": "stop", "enabled": False, "file": None}),
    ({"op": "autonomy", "file": "no such script", "config": MANY}, "autonomy-command",
     {"action": "start", "file": "no such script", "config": MANY}),
    ({"op": "autonomy", "file": "follow"}, "autonomy-command", {"action": "start", "file": "follow", "config": {}}),
    ({"op": "autonomy", "file": ""}, "autonomy-command", {"action": "stop"}),
    ({"op": "outlet", "outlet": "o1", "on": True}, "outlets/o1/power", {"on": True}),
    ({"op": "mcu", "uid": "imu-1", "name": "led", "value": {"on": True, "level": 7}}, "mcu/imu-1/led",
     {"on": True, "level": 7}),
    *(({"op": "action", "name": name}, f"flags/{name}", {"value": True})
      for name in ("reboot", "service-restart", "git-pull")),
    *(({"op": "flag", "name": name, "on": on}, f"flags/{name}", {"value": on})
      for name, on in (("remote-mirror", True), ("mqtt-audio", False), ("mqtt-video", True))),
]
# fmt: on
#: Section and key of the capabilities that may name another topic for it.
NAMED = {
    "lights-solid": ("lights", "solid_topic"),
    "lights-flash": ("lights", "flash_topic"),
    "soundboard-command": ("soundboard", "command_topic"),
    "autonomy-command": ("autonomy", "command_topic"),
    "flags/reboot": ("system.reboot", "flag_topic"),
    "flags/service-restart": ("system.service_restart", "flag_topic"),
    "flags/git-pull": ("system.git_pull", "flag_topic"),
    "flags/mqtt-audio": ("audio", "flag_topic"),
    "flags/mqtt-video": ("video", "flag_topic"),
}


def nested(section: str, value: dict[str, Any]) -> dict[str, Any]:
    """Capabilities with this section."""
    for level in reversed(section.split(".")):
        value = {level: value}
    return value


def published(fields: dict[str, Any], capabilities: dict[str, Any]) -> Message:
    asked, robots = command(**fields), Robots()
    payload = msgspec.json.encode({"schema": "pebble-capabilities/v1", "t": 1, "value": capabilities})
    robots.receive(Message(f"{BASE}/outgoing/capabilities", payload), 0.0)
    return robot_commands.publication(asked, robots.capabilities(asked.ref))


@pytest.mark.parametrize(("fields", "metric", "value"), PUBLISHED)
def test_what_is_published(fields: dict[str, Any], metric: str, value: Any) -> None:
    message = published(fields, {})
    assert (message.topic, json.loads(message.payload)) == (f"{BASE}/incoming/{metric}", value)
    assert (message.qos, message.retain) == (QoS.DELIVERED, fields["op"] == "flag")


@pytest.mark.parametrize(("fields", "metric"), [row[:2] for row in PUBLISHED])
def test_capabilities_may_name_another_topic_of_the_same_robot(fields: dict[str, Any], metric: str) -> None:
    section, key = NAMED.get(metric, ("outlets", "command_topic"))
    own = f"{BASE}/incoming/other"
    usual = f"{BASE}/incoming/{metric}"
    assert published(fields, nested(section, {key: own})).topic == (own if metric in NAMED else usual)
    below = ("#", "a\x01b", "x" * 1100, "/".join("x" * 250), "drive-values", "estop")
    foreign = ["pebble/robots/fred/incoming/x", f"{BASE}/outgoing/x", f"{BASE}x/incoming/x", 7]
    for topic in (*foreign, *(f"{BASE}/incoming/{one}" for one in below)):
        assert published(fields, nested(section, {key: topic})).topic == usual
    for odd in ("text", None):
        assert published(fields, {section.partition(".")[0]: odd}).topic == usual


def test_spellings_of_where_an_action_goes() -> None:
    topic, again = f"{BASE}/incoming/flags/again", {"op": "action", "name": "service-restart"}
    for system in ({"service-restart": {"flag_topic": topic}}, {"service_restart": {"topic": topic}}):
        assert published(again, {"system": system}).topic == topic
    assert published(again, {"service_restart": {"flag_topic": topic}}).topic == topic


def test_which_right_is_needed() -> None:
    for fields, *_ in PUBLISHED:
        needs_system = fields["op"] == "action" or fields.get("name") == "remote-mirror"
        assert robot_commands.right(command(**fields)) == ("system" if needs_system else "drive"), fields


Fields = dict[str, Any]
START: Fields = {"op": "autonomy", "file": "follow"}
SOLID: Fields = {"op": "lights", "r": 1}
FLASH: Fields = {"op": "lights", "r": 1, "period": 1}
HORN: Fields = {"op": "soundboard", "file": "horn.wav"}
OUTLET: Fields = {"op": "outlet", "outlet": "o1", "on": True}


@pytest.mark.parametrize(
    ("fields", "capabilities", "refused"),
    [
        (SOLID, {"lights": {"solid": True, "flash": False}}, ""),
        (FLASH, {"lights": {"solid": True, "flash": False}}, "lights-flash"),
        (SOLID, {"lights": {"solid": False, "flash": True}}, "lights-solid"),
        (SOLID, {"lights": "yes"}, ""),
        (HORN, {"soundboard": {"available": True, "controls": False}}, "soundboard-command"),
        (HORN, {"soundboard": {"available": False}}, "soundboard-command"),
        (START, {"autonomy": {"controls": 0}}, ""),
        ({"op": "action", "name": "reboot"}, {"system": {"reboot": {"controls": False}}}, "flags/reboot"),
        ({"op": "action", "name": "reboot"}, {"system": {"git_pull": {"controls": False}}}, ""),
        ({"op": "flag", "name": "mqtt-video", "on": True}, {"video": {"controls": False}}, "flags/mqtt-video"),
        ({"op": "flag", "name": "mqtt-video", "on": False}, {"video": {"controls": False}}, ""),
        (OUTLET, {"outlets": {"outlets": [{"name": "o1", "controls": False}]}}, "outlets/o1/power"),
        (OUTLET, {"outlets": {"outlets": [{"name": "o2", "controls": False}, "o1"]}}, ""),
        (OUTLET, {"outlets": {"outlets": {"o1": False}}}, ""),
        (OUTLET | {"on": False}, {"outlets": {"outlets": [{"name": "o1", "controls": False}]}}, ""),
        ({"op": "lights", "period": 1}, {"lights": {"flash": False}}, ""),
    ],
)  # fmt: skip
def test_what_capabilities_rule_out(fields: dict[str, Any], capabilities: dict[str, Any], refused: str) -> None:
    asked = command(**fields)
    why = "" if robot_commands.ends(asked) else robot_commands.refusal(asked, capabilities)
    assert why == (refused and f"goob takes no {refused} commands")


def why_not(fields: Fields, *, silent: bool = False, stopped: bool = False, by: str = "", **more: Any) -> str:
    """Why this is not asked of a robot in this state; it ``arbitrates``, unless it is said, and there is no problem."""
    view, robot, problem = RobotView(BASE), Robot(BASE, "serial"), more.get("problem", "")
    view.capabilities = {"drive": {"available": True, "arbitrates": more.get("arbitrates", True)}}
    for ago_s in (0.6, 0.4, 0.2):
        view.liveness.heartbeat(time.monotonic() - ago_s, 0.0, online=not silent)
    for state in robot.take([Message(ESTOP.topic(BASE), b'{"stop":"00000000000000a1"}')] * stopped):
        view.receive(ESTOP_STATE, state, 0.0, 0.0)
    broker: Any = SimpleNamespace(problem=problem, connected=not problem, names=SimpleNamespace(account=""))
    return Refusals(broker, lambda _: by, {BASE: view}.get).of_op(command(**fields))


BEGINS = [fields for fields, *_ in PUBLISHED if not robot_commands.ends(command(**fields))]
ENDS = [fields for fields, *_ in PUBLISHED if robot_commands.ends(command(**fields))]
FLAGS = [fields for fields in BEGINS if fields["op"] == "flag"]
OTHERS = [fields for fields in BEGINS if fields not in FLAGS]
NO_BROKER = "The server cannot reach the broker"
#: What is asked, of a robot in which state, and why it is not.
WHYS: list[tuple[list[Fields], dict[str, Any], str]] = [
    (BEGINS + ENDS, {}, ""),
    (ENDS + FLAGS, {"silent": True}, ""),
    (OTHERS, {"silent": True}, "goob is silent"),
    (BEGINS, {"problem": "refused"}, f"{NO_BROKER}: refused"),
    (ENDS, {"problem": "refused"}, NO_BROKER),
    ([START], {"stopped": True}, "Stopped: reset it first"),
    ([{"op": "autonomy", "file": ""}, SOLID, HORN], {"stopped": True}, ""),
    ([START], {"by": "bob"}, ""),
    ([START], {"by": "bob", "arbitrates": False}, "bob is driving"),
    ([START], {"arbitrates": False}, ""),
]


@pytest.mark.parametrize(("asked", "state", "why"), WHYS)
def test_what_the_state_of_a_robot_rules_out(asked: list[Fields], state: dict[str, Any], why: str) -> None:
    assert {why_not(fields, **state) for fields in asked} == {why}


def test_nothing_is_asked_of_an_unknown_component_and_no_command_passes_for_a_question_of_the_bridges() -> None:
    unknown = Refusals(SimpleNamespace(), lambda _: "", lambda _: None)  # type: ignore[arg-type]
    assert {unknown.of_op(command(**fields)) for fields in BEGINS + ENDS} == {"unknown component"}
    question = {"op": "mcu", "uid": "u1", "name": "describe", "value": {"has": True, "from": True}}
    assert "no command" in why_not(question)


# -- at a server


def asked_of(robot: RecordingRobot) -> list[tuple[str, Any]]:
    """What was received, besides drive commands."""
    prefix = f"{robot.base}/incoming/"
    found = [(topic.removeprefix(prefix), payload) for _, topic, payload in list(robot.received)]
    return [one for one in found if one[0] != "drive-values"]


def test_every_command_reaches_the_robot_in_its_order_and_is_in_the_audit(
    broker: Broker, served: Served, page: Page, robot: RecordingRobot
) -> None:
    """The broker remembers flags and nothing else."""

    def noted() -> list[str]:
        rows = httpx.get(f"{served.origin}/api/audit", params={"ref": robot.base}).json()
        return [f"{row['what']}: {row['detail']}" for row in rows]

    for fields, *_ in PUBLISHED:
        page.send(ref=robot.base, **fields)
    assert until(lambda: len(asked_of(robot)) == len(PUBLISHED)), asked_of(robot)
    assert asked_of(robot) == [row[1:] for row in PUBLISHED]
    assert page.refused == []
    retained: list[Message] = []
    with create("mqtt", "later", MqttSettings(host="127.0.0.1", port=broker.port)) as later:
        later.subscribe(f"{robot.base}/incoming/#", retained.append, direct=True)
        assert until(lambda: len(retained) == 3)
    assert {one.topic.rpartition("/")[2] for one in retained} == {"remote-mirror", "mqtt-audio", "mqtt-video"}
    assert until(lambda: len(noted()) == len(PUBLISHED) - 1), (noted(), page.closed)  # two lights are "on"
    assert noted()[:3] == ["lights: on", "lights: off", "soundboard: file a/horn.wav, repeat False"]
    assert noted()[6:9] == ["autonomy: file follow", "autonomy: file ", "outlet: outlet o1, on True"]


def refusals(page: Page, expected: int = 1) -> list[str]:
    assert until(lambda: len(page.refused) >= expected)
    return [one["why"] for one in page.refused]


def test_without_driving_nothing_is_moved_or_switched_on(served: Served, robot: RecordingRobot) -> None:
    moving = [fields for fields, *_ in PUBLISHED if robot_commands.moves(command(**fields))]
    assert {fields["op"] for fields in moving} == {"autonomy", "mcu", "outlet"}
    with served.page(version="old") as page:
        assert page.knows(robot.base)
        for fields in moving:
            page.send(ref=robot.base, **fields)
        assert all("load it again" in why for why in refusals(page, len(moving)))
        page.send("autonomy", ref=robot.base, file="")
        page.send("outlet", ref=robot.base, outlet="o1", on=False)
        assert until(lambda: len(asked_of(robot)) == 2), asked_of(robot)


BEYOND: list[Fields] = [
    {"op": "autonomy", "file": "x", "config": {str(number): number for number in range(201)}},
    {"op": "autonomy", "file": "x", "config": {"a": {"b": 1}}},
    {"op": "autonomy", "file": "x" * 201},
    {"op": "lights", "r": 1.5},
    {"op": "lights", "period": 0.01},
    {"op": "action", "name": "shutdown"},
    {"op": "outlet", "outlet": "a/b", "on": True},
    {"op": "mcu", "uid": "#", "name": "led", "value": {}},
    {"op": "mcu", "uid": "a", "name": "led", "value": {"x": "text"}},
]


def test_what_is_beyond_the_limits_is_not_understood() -> None:
    for fields in BEYOND:
        with pytest.raises(msgspec.ValidationError):
            command(**fields)
