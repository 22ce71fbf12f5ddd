"""What the server passes on of outlets and microcontrollers, and what it publishes: a real broker, no browser."""

from __future__ import annotations

import json
from typing import Any

import pytest

from pebble.extensions.page.robots import MAX_ALIASES, Interest, Robots
from pebble.transports import Message
from tests.ext.boards import mcu_wire as wire
from tests.ext.page.served import Page
from tests.ext.page.states import described, sample
from tests.kit.played_robot import RecordingRobot
from tests.support import until

BASE = "pebble/robots/lampy"
DESCRIBE = "mcu/lamp-1/describe"


def manifest(*channels: Any) -> dict[str, Any]:
    interfaces = [{"name": f"i{n}", "dir": "out", "channel": channel} for n, channel in enumerate(channels)]
    return described(wire.LAMP) | {"interfaces": interfaces}


def test_what_an_mcu_publishes_under_an_alias_arrives(page: Page, robot: RecordingRobot) -> None:
    page.send("watch", ref=robot.base)
    robot.publish(DESCRIBE, described(wire.LAMP), retain=True)
    robot.publish("lights/lamp", sample("lamp-1", "lamp", {"level": 62.5}), retain=True)
    assert until(lambda: page.value(robot.base, "lights/lamp", "value") == {"level": 62.5})
    assert page.value(robot.base, DESCRIBE, "device_uid") == "lamp-1"
    robot.publish("lights/other", {"value": 1}, retain=True)
    robot.publish("mcu/lamp-1/glow", sample("lamp-1", "glow", {"lux": 1.5}))
    assert until(lambda: page.value(robot.base, "mcu/lamp-1/glow", "value") == {"lux": 1.5})
    assert page.value(robot.base, "lights/other") is None


# -- without a broker


def receive(robots: Robots, metric: str, payload: Any) -> None:
    raw = payload if isinstance(payload, bytes) else json.dumps(payload).encode()
    robots.receive(Message(f"{BASE}/outgoing/{metric}", raw), 1.0)


#: What is defined elsewhere, or cannot be a part of a topic.
NO_ALIASES = [
    "", 1, None, True, [], {"a": 1},
    "front-camera", "audio", "logs", "online", "capabilities",
    "estop/base", "estops", "control/x", "by/x",
    "web/estop", "web/driver", "web", "mcu/other/lamp", "mcu/x/y/z", "mcu",
    "#", "a/#", "+", "a/+/b", "/a", "a//b", "a/", "$SYS", "a\0b", "a\nb", "a" * 65, "/".join(["a" * 30] * 8),
]  # fmt: skip


def test_only_a_free_channel_becomes_an_alias() -> None:
    def aliases(channel: Any) -> list[str]:
        robots = Robots()
        receive(robots, DESCRIBE, manifest(channel, channel))
        return robots.aliases(BASE)

    assert [one for one in NO_ALIASES if aliases(one)] == []
    # the first one is the contract's in the other direction only: nothing arrives there
    assert [aliases(one) for one in ("drive-values", "a/b")] == [["drive-values"], ["a/b"]]


@pytest.mark.parametrize(
    "payload",
    [[], "x", 7, {}, {"interfaces": 1}, {"interfaces": [1, None, [], "x", {}, {"dir": "in", "channel": "a/b"}]}],
)
def test_a_manifest_of_any_shape_is_read(payload: Any) -> None:
    robots = Robots()
    receive(robots, DESCRIBE, payload)
    assert robots.aliases(BASE) == []
    assert robots.value(BASE, DESCRIBE) is not None


FIELD = {"name": "x", "type": "u8"}
INTERFACE = {"name": "a", "dir": "out", "encoding": {"fields": [FIELD]}}
BARE = {"model": "", "firmware_version": "", "interfaces": []}
TAG = {"key": "tag", "type": "int", "min": 0}
FORM = {"key": "tag", "label": "tag", "type": "int", "default": None, "arg": "", "min": 0}
#: Metrics, what a robot publishes, and what pages get of it.
SHOWN: list[tuple[str, Any, Any]] = [
    ("soundboard-files", {"files": ["a.wav"], "more": 1}, {"files": ["a.wav"], "more": 1}),
    ("soundboard-files", {"value": {"files": ["a.wav"]}}, {"files": ["a.wav"]}),
    *[("soundboard-files", value, {}) for value in (7, [], {"files": 7}, {"files": ["a", 7]})],
    ("soundboard-status", {"playing": True, "file": {"x": 1}}, {}),
    *[("autonomy-status", value, {}) for value in (None, {"running": 1}, {"running": True, "dependencies": ["x"]})],
    ("autonomy-status", {"running": True, "file": None}, {"running": True, "file": None}),
    *[("autonomy-files", value, {}) for value in (None, "x", {}, {"files": {}})],
    ("autonomy-files", {"files": [{"file": "a", "configs": [TAG, 7, {}]}, {"file": 7}, "b"]},
     {"files": [{"file": "a", "configs": [FORM]}]}),
    ("autonomy-files", {"files": [{"file": "a", "label": 7}, {"file": ""}]}, {"files": []}),
    (DESCRIBE, 7, BARE),
    (DESCRIBE, {"model": {}, "firmware_version": ["x"], "interfaces": [7, INTERFACE, {**INTERFACE, "dir": "up"}]},
     {**BARE, "interfaces": [INTERFACE]}),
    ("outlets/o1/status", {"value": {"on": True}, "label": "Lamp"}, {"value": {"on": True}, "label": "Lamp"}),
    *[("outlets/o1/status", value, {}) for value in (7, {"value": []}, {"value": {"on": "yes"}})],
    ("media-status", {"t": 1, "value": {"camera": {"running": True}}}, {"camera": {"running": True}}),
    *[("media-status", {"t": 1, "value": {"camera": value}}, {}) for value in ("x", {"running": True, "problem": 7})],
    ("neighbours", {"receives": ["x"]}, {}),
    *[("capabilities", value, {}) for value in (7, [], {"t": 1, "value": 7})],
    ("capabilities", {"t": 1, "value": {"drive": {}, "mine": 7}}, {"t": 1, "value": {"drive": {}, "mine": 7}}),
    ("capabilities", {"value": {"lights": 7, "identity": {"name": 7}, "outlets": {"outlets": [1]}, "reboot": True}},
     {"value": {"reboot": True}}),
    ("status", 7, 7),
]  # fmt: skip


@pytest.mark.parametrize(("metric", "payload", "expected"), SHOWN)
def test_pages_get_what_their_cards_rely_on(metric: str, payload: Any, expected: Any) -> None:
    robots = Robots()
    receive(robots, metric, payload)
    assert json.loads(bytes(robots.value(BASE, metric) or b"null")) == expected


@pytest.mark.parametrize("metric", ["status", "online", "charging-level"])
def test_pages_get_a_value_without_the_bytes_around_it(metric: str) -> None:
    robots = Robots()
    robots.receive(Message(f"{BASE}/outgoing/{metric}", b'\xef\xbb\xbf{"t":1,"value":{}}\r\n\0'), 1.0)
    assert bytes(robots.value(BASE, metric) or b"") == b'{"t":1,"value":{}}'
    robots.receive(Message(f"{BASE}/outgoing/{metric}", b"\0"), 1.0)  # not even an empty payload
    assert robots.value(BASE, metric) is not None


def test_there_is_an_end_to_aliases() -> None:
    robots = Robots()
    for device in range(4):
        receive(robots, f"mcu/m{device}/describe", manifest(*(f"x/{device}-{n}" for n in range(100))))
    assert len(robots.aliases(BASE)) == MAX_ALIASES


def test_aliases_end_with_their_manifest() -> None:
    robots = Robots()
    interest = Interest(lambda: None)
    robots.join(interest)
    robots.watch(interest, BASE)
    receive(robots, DESCRIBE, manifest("a/b"))
    assert [value[:2] for value in robots.take(interest, 2.0, large=False)[0]] == [(BASE, DESCRIBE)]
    receive(robots, DESCRIBE, b"")
    assert robots.aliases(BASE) == []
    assert robots.take(interest, 3.0, large=False) == (((BASE, DESCRIBE, None, 0.0),), False)
