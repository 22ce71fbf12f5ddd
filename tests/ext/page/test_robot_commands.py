"""What pages ask of robots besides driving: what is published, on which topic, and what is refused."""

from __future__ import annotations

import json
import time
from types import SimpleNamespace
from typing import Any

import httpx
import msgspec
import pytest

from pebble.contract import CAPABILITIES, ESTOP, ESTOP_STATE, codec
from pebble.contract.payloads import Capabilities
from pebble.extensions.fleet.roles import Role, page_rights
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.extensions.page import messages as m
from pebble.extensions.page import robot_commands
from pebble.extensions.page.drive.refusals import Refusals
from pebble.extensions.page.robots import Interest, Robots
from pebble.transports import Message, MqttSettings, QoS, create
from tests.ext.operator.client.estop_robot import Robot
from tests.ext.page.served import Page, Served
from tests.kit.played_robot import RecordingRobot
from tests.support import Broker, until

BASE = "pebble/robots/goob"
_decoder = msgspec.json.Decoder(m.FromPage)


def op(tag: str, **fields: Any) -> Any:
    """The command as the server reads it."""
    return _decoder.decode(json.dumps({"op": tag, "ref": BASE, **fields}))


MANY = {"a": 1, "b": 0.5, "c": True, "d": "x", "e": None}
_HORN = {"action": "play", "enabled": True}
# fmt: off
#: What a page sends, and what is published below the robot's ``incoming/``: metric, and value. Flags are retained.
PUBLISHED: list[tuple[dict[str, Any], str, Any]] = [
    ({"tag": "lights", "r": 1, "g": 0.5}, "lights-solid", {"b": 0.0, "g": 0.5, "r": 1.0}),
    ({"tag": "lights", "b": 1, "period": 0.5}, "lights-flash", {"b": 1.0, "g": 0.0, "r": 0.0, "period": 0.5}),
    ({"tag": "lights"}, "lights-solid", {"b": 0.0, "g": 0.0, "r": 0.0}),
    ({"tag": "soundboard", "file": "a/horn.wav"}, "soundboard-command", {**_HORN, "file": "a/horn.wav"}),
    ({"tag": "soundboard", "file": "horn.wav", "repeat": True}, "soundboard-command",
     {**_HORN, "file": "horn.wav", "repeat": True}),
    ({"tag": "soundboard", "file": ""}, "soundboard-command", {"action": "stop", "enabled": False, "file": None}),
    ({"tag": "autonomy", "file": "no such script", "config": MANY}, "autonomy-command",
     {"action": "start", "file": "no such script", "config": MANY}),
    ({"tag": "autonomy", "file": "follow"}, "autonomy-command", {"action": "start", "file": "follow", "config": {}}),
    ({"tag": "autonomy", "file": ""}, "autonomy-command", {"action": "stop"}),
    ({"tag": "outlet", "outlet": "o1", "on": True}, "outlets/o1/power", {"on": True}),
    ({"tag": "mcu", "uid": "imu-1", "name": "led", "value": {"on": True, "level": 7}}, "mcu/imu-1/led",
     {"on": True, "level": 7}),
    *(({"tag": "action", "name": name}, f"flags/{name}", {"value": True})
      for name in ("reboot", "service-restart", "git-pull")),
    *(({"tag": "flag", "name": name, "on": on}, f"flags/{name}", {"value": on})
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


def published(asked: Any, capabilities: dict[str, Any]) -> Message:
    robots = Robots()
    payload = msgspec.json.encode({"schema": "pebble-capabilities/v1", "t": 1, "value": capabilities})
    robots.receive(Message(f"{BASE}/outgoing/capabilities", payload), 0.0)
    return robot_commands.publication(asked, robots.capabilities(asked.ref))


@pytest.mark.parametrize(("fields", "metric", "value"), PUBLISHED)
def test_what_is_published(fields: dict[str, Any], metric: str, value: Any) -> None:
    message = published(op(**fields), {})
    assert (message.topic, json.loads(message.payload)) == (f"{BASE}/incoming/{metric}", value)
    assert (message.qos, message.retain) == (QoS.DELIVERED, fields["tag"] == "flag")


@pytest.mark.parametrize(("fields", "metric"), [row[:2] for row in PUBLISHED])
def test_capabilities_may_name_another_topic_of_the_same_robot(fields: dict[str, Any], metric: str) -> None:
    section, key = NAMED.get(metric, ("outlets", "command_topic"))
    own = f"{BASE}/incoming/other"
    usual = f"{BASE}/incoming/{metric}"
    assert published(op(**fields), nested(section, {key: own})).topic == (own if metric in NAMED else usual)
    below = ("#", "a\x01b", "x" * 1100, "/".join("x" * 250), "drive-values", "estop")
    foreign = ["pebble/robots/fred/incoming/x", f"{BASE}/outgoing/x", f"{BASE}x/incoming/x", 7, None]
    for topic in (*foreign, *(f"{BASE}/incoming/{one}" for one in below)):
        assert published(op(**fields), nested(section, {key: topic})).topic == usual
    for odd in ("text", ["list"], None, 1):
        assert published(op(**fields), {section.partition(".")[0]: odd}).topic == usual


@pytest.mark.parametrize(
    "section",
    [
        {"system": {"service_restart": {"flag_topic": f"{BASE}/incoming/flags/again"}}},
        {"system": {"service-restart": {"flag_topic": f"{BASE}/incoming/flags/again"}}},
        {"system": {"service_restart": {"topic": f"{BASE}/incoming/flags/again"}}},
        {"service_restart": {"flag_topic": f"{BASE}/incoming/flags/again"}},
    ],
    ids=["ours", "with a dash", "topic", "at the top"],
)
def test_spellings_of_where_an_action_goes(section: dict[str, Any]) -> None:
    assert published(op("action", name="service-restart"), section).topic == f"{BASE}/incoming/flags/again"
    assert published(op("action", name="reboot"), section).topic == f"{BASE}/incoming/flags/reboot"


@pytest.mark.parametrize("fields", [row[0] for row in PUBLISHED], ids=str)
def test_which_right_is_needed(fields: dict[str, Any]) -> None:
    right = robot_commands.right(op(**fields))
    assert right == ("system" if fields["tag"] == "action" or fields.get("name") == "remote-mirror" else "drive")
    assert [role.value for role in Role if right in page_rights(role)] == (
        ["maintainer", "admin"] if right == "system" else ["driver", "maintainer", "safety", "admin"]
    )


Fields = dict[str, Any]
START: Fields = {"tag": "autonomy", "file": "follow"}
SOLID: Fields = {"tag": "lights", "r": 1}
FLASH: Fields = {"tag": "lights", "r": 1, "period": 1}
HORN: Fields = {"tag": "soundboard", "file": "horn.wav"}
OUTLET: Fields = {"tag": "outlet", "outlet": "o1", "on": True}


@pytest.mark.parametrize(
    ("fields", "capabilities", "refused"),
    [
        (SOLID, {"lights": {"solid": True, "flash": False}}, ""),
        (FLASH, {"lights": {"solid": True, "flash": False}}, "lights-flash"),
        (SOLID, {"lights": {"solid": False, "flash": True}}, "lights-solid"),
        (SOLID, {"lights": {"available": True, "controls": False}}, "lights-solid"),
        (SOLID, {"lights": "yes"}, ""),
        (HORN, {"soundboard": {"available": True, "controls": False}}, "soundboard-command"),
        (HORN, {"soundboard": {"available": False}}, "soundboard-command"),
        (HORN, {}, ""),
        (START, {"autonomy": {"controls": False}}, "autonomy-command"),
        (START, {"autonomy": {"controls": 0}}, ""),
        ({"tag": "action", "name": "reboot"}, {"system": {"reboot": {"controls": False}}}, "flags/reboot"),
        ({"tag": "action", "name": "reboot"}, {"system": {"git_pull": {"controls": False}}}, ""),
        ({"tag": "flag", "name": "mqtt-video", "on": True}, {"video": {"controls": False}}, "flags/mqtt-video"),
        ({"tag": "flag", "name": "mqtt-video", "on": False}, {"video": {"controls": False}}, ""),
        ({"tag": "flag", "name": "remote-mirror", "on": True}, {}, ""),
        (OUTLET, {"outlets": {"outlets": [{"name": "o1", "controls": False}]}}, "outlets/o1/power"),
        (OUTLET, {"outlets": {"outlets": [{"name": "o2", "controls": False}, "o1"]}}, ""),
        (OUTLET, {"outlets": {"controls": False, "outlets": {"o1": False}}}, ""),
        (OUTLET | {"on": False}, {"outlets": {"outlets": [{"name": "o1", "controls": False}]}}, ""),
        ({"tag": "lights"}, {"lights": {"solid": False}}, ""),
        ({"tag": "lights", "period": 1}, {"lights": {"flash": False}}, ""),
    ],
)  # fmt: skip
def test_what_capabilities_rule_out(fields: dict[str, Any], capabilities: dict[str, Any], refused: str) -> None:
    asked = op(**fields)
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
    return Refusals(broker, lambda _: by, {BASE: view}.get).of_op(op(**fields))


BEGINS = [fields for fields, *_ in PUBLISHED if not robot_commands.ends(op(**fields))]
ENDS = [fields for fields, *_ in PUBLISHED if robot_commands.ends(op(**fields))]
FLAGS = [fields for fields in BEGINS if fields["tag"] == "flag"]
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
    ([{"tag": "autonomy", "file": ""}, SOLID, HORN], {"stopped": True}, ""),
    ([START], {"by": "bob"}, ""),
    ([START], {"by": "bob", "arbitrates": False}, "bob is driving"),
    ([START], {"arbitrates": False}, ""),
]


@pytest.mark.parametrize(("asked", "state", "why"), WHYS)
def test_what_the_state_of_a_robot_rules_out(asked: list[Fields], state: dict[str, Any], why: str) -> None:
    assert {why_not(fields, **state) for fields in asked} == {why}


def test_nothing_is_asked_of_an_unknown_component_and_no_command_passes_for_a_question_of_the_bridges() -> None:
    unknown = Refusals(SimpleNamespace(), lambda _: "", lambda _: None)  # type: ignore[arg-type]
    assert {unknown.of_op(op(**fields)) for fields in BEGINS + ENDS} == {"unknown component"}
    question = {"tag": "mcu", "uid": "u1", "name": "describe", "value": {"has": True, "from": True}}
    assert "no command" in why_not(question)


# -- at a server


def asked_of(robot: RecordingRobot) -> list[tuple[str, Any]]:
    """What was received, besides drive commands."""
    prefix = f"{robot.base}/incoming/"
    found = [(topic.removeprefix(prefix), payload) for _, topic, payload in list(robot.received)]
    return [one for one in found if one[0] != "drive-values"]


def ask(page: Page, ref: str, tag: str, **fields: Any) -> None:
    page.send(tag, ref=ref, **fields)


def test_every_command_reaches_the_robot_in_its_order_and_is_in_the_audit(
    broker: Broker, served: Served, page: Page, robot: RecordingRobot
) -> None:
    """The broker remembers flags and nothing else; the audit has no lights and sounds."""

    def noted() -> list[str]:
        rows = httpx.get(f"{served.origin}/api/audit", params={"ref": robot.base}).json()
        return [f"{row['what']}: {row['detail']}" for row in rows]

    for fields, *_ in PUBLISHED:
        ask(page, robot.base, **fields)
    assert until(lambda: len(asked_of(robot)) == len(PUBLISHED), 5), asked_of(robot)
    assert asked_of(robot) == [row[1:] for row in PUBLISHED]
    assert page.refused == []
    retained: list[Message] = []
    with create("mqtt", "later", MqttSettings(host="127.0.0.1", port=broker.port)) as later:
        later.subscribe(f"{robot.base}/incoming/#", retained.append, direct=True)
        assert until(lambda: len(retained) == 3, 3)
    assert {one.topic.rpartition("/")[2] for one in retained} == {"remote-mirror", "mqtt-audio", "mqtt-video"}
    assert until(lambda: len(noted()) == len(PUBLISHED) - 6), (noted(), page.closed)
    assert noted()[1:4] == [
        "autonomy: file follow",
        "autonomy: file ",
        "outlet: outlet o1, on True",
    ]
    assert noted()[-1] == "flag: name mqtt-video, on True"


def refusals(page: Page, expected: int = 1) -> list[str]:
    assert until(lambda: len(page.refused) >= expected, 3)
    return [one["why"] for one in page.refused]


def test_without_driving_nothing_is_moved_or_switched_on(served: Served, robot: RecordingRobot) -> None:
    moving = [fields for fields, *_ in PUBLISHED if robot_commands.moves(op(**fields))]
    assert {fields["tag"] for fields in moving} == {"autonomy", "mcu", "outlet"}
    with served.page(version="old") as page:
        assert page.knows(robot.base)
        for fields in moving:
            ask(page, robot.base, **fields)
        assert all("load it again" in why for why in refusals(page, len(moving)))
        ask(page, robot.base, "autonomy", file="")
        ask(page, robot.base, "outlet", outlet="o1", on=False)
        assert until(lambda: len(asked_of(robot)) == 2, 3), asked_of(robot)


def test_large_values_are_sent_one_at_a_time() -> None:
    robots, interest = Robots(), Interest(lambda: None)
    robots.join(interest)
    for name in ("a", "b"):
        topic = f"pebble/robots/{name}/outgoing/capabilities"
        robots.receive(Message(topic, codec.encode(CAPABILITIES, Capabilities(t=1, value={"x": "y" * 20_000}))), 0.0)
    robots.set_server_metric("", "web/broker", {"connected": True})

    def taken(*, large: bool) -> tuple[set[str], bool]:
        values, had = robots.take(interest, 1.0, large=large)
        return {ref.rpartition("/")[2] for ref, metric, *_ in values if metric == "capabilities"}, had

    assert taken(large=False) == (set(), False)
    first, had = taken(large=True)
    assert had
    assert taken(large=False) == (set(), False)
    assert (first | taken(large=True)[0], len(first)) == ({"a", "b"}, 1)
    assert taken(large=True) == (set(), False)


BEYOND: list[Fields] = [
    {"tag": "autonomy", "file": "x", "config": {str(number): number for number in range(201)}},
    {"tag": "autonomy", "file": "x", "config": {"a": {"b": 1}}},
    {"tag": "autonomy", "file": "x" * 201},
    {"tag": "soundboard", "file": "x" * 1001},
    {"tag": "lights", "r": 1.5},
    {"tag": "lights", "r": "1"},
    {"tag": "lights", "period": 0.01},
    {"tag": "action", "name": "shutdown"},
    {"tag": "outlet", "outlet": "a/b", "on": True},
    {"tag": "outlet", "outlet": "a\x01", "on": True},
    {"tag": "outlet", "outlet": "o1", "on": 1},
    {"tag": "mcu", "uid": "#", "name": "led", "value": {}},
    {"tag": "mcu", "uid": "a", "name": "led", "value": {"x": "text"}},
]


@pytest.mark.parametrize("fields", BEYOND)
def test_what_is_beyond_the_limits_is_not_understood(fields: Fields) -> None:
    with pytest.raises(msgspec.ValidationError):
        op(**fields)
