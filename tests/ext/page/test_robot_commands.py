"""What pages ask of robots besides driving: what is published, on which topic, and what is refused."""

from __future__ import annotations

import itertools
import json
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import pytest

from pebble.contract import CAPABILITIES, codec
from pebble.contract.payloads import Capabilities
from pebble.extensions.fleet.roles import Role, page_rights
from pebble.extensions.page import messages as m
from pebble.extensions.page import robot_commands
from pebble.extensions.page.robots import Interest, Robots
from pebble.transports import Message, MqttSettings, QoS, create
from tests.ext.page.attacker import Hall
from tests.ext.page.served import Page, Served, now_ms
from tests.kit.played_robot import RecordingRobot
from tests.support import Broker, until

BASE = "pebble/robots/goob"
NUMBERS = itertools.count(1)
_decoder = msgspec.json.Decoder(m.FromPage)


def op(tag: str, **fields: Any) -> Any:
    """The command as the server reads it."""
    return _decoder.decode(json.dumps({"op": tag, "ref": BASE, **fields}))


#: What a page sends, and what is published below the robot's ``incoming/``: metric, value, and whether it is retained.
PUBLISHED: list[tuple[dict[str, Any], str, Any, bool]] = [
    ({"tag": "lights", "r": 1, "g": 0.5}, "lights-solid", {"b": 0.0, "g": 0.5, "r": 1.0}, False),
    ({"tag": "lights", "b": 1, "period": 0.5}, "lights-flash", {"b": 1.0, "g": 0.0, "r": 0.0, "period": 0.5}, False),
    ({"tag": "lights"}, "lights-solid", {"b": 0.0, "g": 0.0, "r": 0.0}, False),
    (
        {"tag": "soundboard", "file": "a/horn.wav"},
        "soundboard-command",
        {"action": "play", "enabled": True, "file": "a/horn.wav"},
        False,
    ),
    (
        {"tag": "soundboard", "file": "horn.wav", "repeat": True},
        "soundboard-command",
        {"action": "play", "enabled": True, "file": "horn.wav", "repeat": True},
        False,
    ),
    (
        {"tag": "soundboard", "file": ""},
        "soundboard-command",
        {"action": "stop", "enabled": False, "file": None},
        False,
    ),
    (
        {"tag": "autonomy", "file": "no such script", "config": {"a": 1, "b": 0.5, "c": True, "d": "x", "e": None}},
        "autonomy-command",
        {"action": "start", "file": "no such script", "config": {"a": 1, "b": 0.5, "c": True, "d": "x", "e": None}},
        False,
    ),
    (
        {"tag": "autonomy", "file": "follow"},
        "autonomy-command",
        {"action": "start", "file": "follow", "config": {}},
        False,
    ),
    ({"tag": "autonomy", "file": ""}, "autonomy-command", {"action": "stop"}, False),
    ({"tag": "outlet", "outlet": "o1", "on": True}, "outlets/o1/power", {"on": True}, False),
    (
        {"tag": "mcu", "uid": "imu-1", "name": "led", "value": {"on": True, "level": 7}},
        "mcu/imu-1/led",
        {"on": True, "level": 7},
        False,
    ),
    ({"tag": "action", "name": "reboot"}, "flags/reboot", {"value": True}, False),
    ({"tag": "action", "name": "service-restart"}, "flags/service-restart", {"value": True}, False),
    ({"tag": "action", "name": "git-pull"}, "flags/git-pull", {"value": True}, False),
    ({"tag": "flag", "name": "remote-mirror", "on": True}, "flags/remote-mirror", {"value": True}, True),
    ({"tag": "flag", "name": "mqtt-audio", "on": False}, "flags/mqtt-audio", {"value": False}, True),
    ({"tag": "flag", "name": "mqtt-video", "on": True}, "flags/mqtt-video", {"value": True}, True),
]
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


@pytest.mark.parametrize(("fields", "metric", "value", "retain"), PUBLISHED)
def test_what_is_published(fields: dict[str, Any], metric: str, value: Any, retain: bool) -> None:
    message = published(op(**fields), {})
    assert (message.topic, json.loads(message.payload)) == (f"{BASE}/incoming/{metric}", value)
    assert (message.qos, message.retain) == (QoS.DELIVERED, retain)


@pytest.mark.parametrize(("fields", "metric"), [(fields, metric) for fields, metric, _, _ in PUBLISHED])
def test_capabilities_may_name_another_topic_of_the_same_robot(fields: dict[str, Any], metric: str) -> None:
    section, key = NAMED.get(metric, ("outlets", "command_topic"))
    own = f"{BASE}/incoming/other"
    usual = f"{BASE}/incoming/{metric}"
    assert published(op(**fields), nested(section, {key: own})).topic == (own if metric in NAMED else usual)
    foreign = [
        "pebble/robots/fred/incoming/x",
        f"{BASE}/outgoing/x",
        f"{BASE}/incoming/#",
        f"{BASE}/incoming/a\x01b",
        f"{BASE}/incoming/{'x' * 1100}",
        f"{BASE}/incoming{'/x' * 250}",
        f"{BASE}/incoming/drive-values",
        f"{BASE}/incoming/estop",
        f"{BASE}x/incoming/x",
        7,
        None,
    ]
    for topic in foreign:
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


@pytest.mark.parametrize("fields", [fields for fields, _, _, _ in PUBLISHED], ids=str)
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
        return [f"{one.what}: {one.detail}" for one in served.app.state.audit.read(100) if one.ref == robot.base]

    for fields, *_ in PUBLISHED:
        ask(page, robot.base, **fields)
    assert until(lambda: len(asked_of(robot)) == len(PUBLISHED), 5), asked_of(robot)
    assert asked_of(robot) == [(metric, value) for _, metric, value, _ in PUBLISHED]
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


def test_nothing_is_asked_of_an_unknown_component(page: Page, robot: RecordingRobot) -> None:
    for number, (fields, *_) in enumerate(PUBLISHED):
        ask(page, "pebble/robots/unheard", **fields)
        assert refusals(page, number + 1)[-1] == "unknown component"
    for ref in ("", "pebble/robots/+", "#", robot.base + "/incoming"):
        ask(page, ref, **SOLID)
    assert refusals(page, len(PUBLISHED) + 4)[-4:] == ["unknown component"] * 4
    assert asked_of(robot) == []


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


def test_no_command_passes_for_a_question_of_the_bridges(page: Page, robot: RecordingRobot) -> None:
    ask(page, robot.base, "mcu", uid="u1", name="describe", value={"has": True, "from": True})
    assert "no command" in refusals(page)[0]
    assert asked_of(robot) == []


def test_a_silent_robot_is_asked_nothing_but_to_end_and_its_flags(page: Page, robot: RecordingRobot) -> None:
    robot.silent()
    assert until(lambda: page.value(robot.base, "web/liveness", "online") is False, 4)
    for fields, *_ in PUBLISHED:
        ask(page, robot.base, **fields)
    assert until(lambda: len(asked_of(robot)) == 6, 3), asked_of(robot)
    assert [value for _, value in asked_of(robot)[:3]] == [
        {"b": 0.0, "g": 0.0, "r": 0.0}, {"action": "stop", "enabled": False, "file": None}, {"action": "stop"},
    ]  # fmt: skip
    assert set(refusals(page, len(PUBLISHED) - 6)) == {f"{robot.base.rpartition('/')[2]} is silent"}


def test_clips_and_scripts_on_topics_that_the_robot_names(
    broker: Broker, served: Served, robot: RecordingRobot
) -> None:
    base = f"pebble/robots/asked{next(NUMBERS)}"
    own = f"{base}/outgoing/renamed"
    named = {"soundboard": {"files_topic": f"{own}/clips", "status_topic": f"{robot.base}/outgoing/soundboard-status"}}
    named["autonomy"] = {"files_topic": f"{own}/scripts", "status_topic": f"{own}/script"}
    with RecordingRobot(broker.port, base, capabilities=named) as one, served.page() as page:
        assert page.knows(base)
        page.send("watch", ref=base)
        robot.publish("soundboard-status", {"playing": True, "file": "foreign"}, retain=True)
        values = {
            "clips": ("soundboard-files", {"files": ["a.wav"]}),
            "scripts": ("autonomy-files", {"files": []}),
            "script": ("autonomy-status", {"running": True, "file": "follow"}),
        }
        for topic, (metric, value) in values.items():
            one.publish(f"renamed/{topic}", value, retain=True)
            assert until(partial(page.value, base, metric), 3), metric
            assert value.items() <= page.value(base, metric).items()
        assert page.value(base, "soundboard-status") is None


def test_a_long_list_of_clips_is_passed_on(page: Page, robot: RecordingRobot) -> None:
    files = [f"speech/number {number}, spoken by a person.wav" for number in range(6000)]  # 256 KiB of names
    page.send("watch", ref=robot.base)
    robot.publish("soundboard-files", {"files": files, "timestamp": 1.0}, retain=True)
    assert until(lambda: page.value(robot.base, "soundboard-files", "files") == files, 5)


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


def test_a_stopped_robot_starts_no_script_but_may_end_one(page: Page, robot: RecordingRobot) -> None:
    page.send("estop", ref=robot.base, stop="00000000000000a1")
    assert until(lambda: page.value(robot.base, "web/estop", "latched") is True)
    before = len(asked_of(robot))
    ask(page, robot.base, **START)
    assert refusals(page) == ["Stopped: reset it first"]
    for fields in ({"tag": "autonomy", "file": ""}, SOLID, HORN):
        ask(page, robot.base, **fields)
    assert until(lambda: len(asked_of(robot)) >= before + 3)
    assert [metric for metric, _ in asked_of(robot)[-3:]] == ["autonomy-command", "lights-solid", "soundboard-command"]


@pytest.mark.parametrize("arbitrates", [True, False])
def test_a_script_starts_beside_a_person_only_where_it_gives_way(
    broker: Broker, served: Served, arbitrates: bool
) -> None:
    base = f"pebble/robots/asked{next(NUMBERS)}"
    capabilities = {"drive": {"available": True, "controls": True, "arbitrates": arbitrates}}
    with RecordingRobot(broker.port, base, capabilities=capabilities) as robot, served.page() as page:
        assert page.knows(base)
        assert page.ready()
        assert page.take(base)
        page.send("drive", ref=base, g=1, t=now_ms(), z=0.5)
        ask(page, base, **START)
        assert until(lambda: asked_of(robot) or page.refused)
        assert [one["why"] for one in page.refused] == ([] if arbitrates else ["somebody without a login is driving"])
        page.send("drive", ref=base, g=1, t=now_ms())
        ask(page, base, **START)
        assert until(lambda: len(asked_of(robot)) == (2 if arbitrates else 1), 3)


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


def test_the_broker_is_down(broker: Broker, page: Page, robot: RecordingRobot) -> None:
    broker.freeze()
    ask(page, robot.base, **SOLID)  # accepted, and never acknowledged
    assert until(lambda: page.value("", "web/broker", "problem"), 5)
    ask(page, robot.base, **START)
    assert refusals(page)[0].startswith("The server cannot reach the broker: ")
    broker.thaw()


def test_who_may_what(broker: Broker, tmp_path: Path) -> None:
    with (
        Hall(broker.port, tmp_path) as hall,
        RecordingRobot(broker.port, f"pebble/robots/asked{next(NUMBERS)}") as robot,
    ):
        actions = [fields for fields, *_ in PUBLISHED if fields["tag"] == "action"]
        with hall.page("driver") as page:
            assert page.knows(robot.base)
            for fields in actions:
                ask(page, robot.base, **fields)
            assert refusals(page, len(actions)) == ["The role driver may not do this"] * len(actions)
            assert asked_of(robot) == []
            ask(page, robot.base, **SOLID)
            assert until(lambda: asked_of(robot))
        with hall.page("maintainer") as page:
            assert page.knows(robot.base)
            ask(page, robot.base, **actions[0])
            assert until(lambda: asked_of(robot)[-1] == ("flags/reboot", {"value": True}))
        audit = hall.served.app.state.audit
        assert until(lambda: [(one.what, one.user) for one in audit.read(10) if one.ref] == [("action", "maintainer")])
