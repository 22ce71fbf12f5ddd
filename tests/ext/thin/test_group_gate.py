"""Groups of commands at a bridge, in virtual time: all of a group passes, or nothing that moves."""

from collections.abc import Callable
from typing import Any

import msgspec
import pytest

from pebble.contract import groups
from pebble.errors import ConfigError, PayloadError
from pebble.extensions.thin.group_gate import copy_of, is_marked
from pebble.extensions.thin.uplink import MediaHold
from pebble.forwarding.forwarder import Forwarder
from pebble.forwarding.routing import Drop, Forward
from pebble.launcher.capabilities import capabilities
from pebble.runtime.addresses import Addresses
from tests.forwarding.virtual import World
from tests.services.mqtt_bridge.bridge_rig import make_config

GROUP, DRIVE, SOUND = "incoming/group", "incoming/drive-values", "incoming/soundboard-command"
BOTH = b'{"drive-values": {"z": 0.5}, "lights-solid": {"r": 1}}'
ZERO = b'{"drive-values": {"z": 0}, "lights-solid": {"r": 1}}'
SIGNED = b'{"drive-values": {"z": 0.5, "source": "autonomy", "run": 3}, "lights-solid": {"r": 1}}'
SIGNED_ZERO = b'{"drive-values": {"z": 0, "source": "autonomy", "run": 3}, "lights-solid": {"r": 1}}'
QUIET = b'{"soundboard-command": {"action": "stop"}, "drive-values": {"z": 0.5}}'

Start = Callable[..., World]


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch) -> Start:
    def started(profile: str = "wide", *, on: bool = True, **section: Any) -> World:
        world = World("bridge", monkeypatch)
        world.start(link={"profile": profile, "groups": on}, **section)
        world.run()
        world.local.seen.clear()
        return world

    return started


def arrived(world: World) -> list[tuple[str, Any]]:
    """What has come to the robot, without the bridge's own messages."""
    below = f"{world.local.base}/incoming/"
    return [
        (message.topic.removeprefix(below), msgspec.json.decode(message.payload))
        for message in world.local.seen
        if message.topic.startswith(below)
    ]


COPIES = [("drive-values", {"z": 0.5, "group": True}), ("lights-solid", {"r": 1, "group": True})]


@pytest.mark.parametrize("profile", ["wide", "thin"])
def test_a_group_passes_whole_and_then_as_copies(start: Start, profile: str, monkeypatch: pytest.MonkeyPatch) -> None:
    noted: list[float] = []  # when media begin to wait
    monkeypatch.setattr(MediaHold, "note_drive", lambda _self, now: noted.append(now))
    world = start(profile)
    world.remote.publish(GROUP, BOTH)
    world.run(0.1)
    assert arrived(world) == [("group", {"drive-values": {"z": 0.5}, "lights-solid": {"r": 1}}), *COPIES]
    assert len(noted) == (profile == "thin")


def test_a_bridge_that_ends_behind_the_group_leaves_it_whole(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    world, deliver = start(), Forwarder.deliver

    def deliver_once(*arguments: Any) -> Forward | Drop:
        monkeypatch.setattr(Forwarder, "deliver", lambda *_: Drop.NO_ROOM)
        return deliver(*arguments)

    monkeypatch.setattr(Forwarder, "deliver", deliver_once)
    world.remote.publish(GROUP, BOTH)
    world.run(0.1)
    assert arrived(world) == [("group", {"drive-values": {"z": 0.5}, "lights-solid": {"r": 1}})]


def test_without_the_key_a_group_is_a_command_like_any_unknown_one(start: Start) -> None:
    world = start(on=False)
    world.remote.publish(GROUP, BOTH)
    world.run(0.1)
    assert [(message.topic, message.payload) for message in world.local.seen] == [(f"{world.local.base}/{GROUP}", BOTH)]


@pytest.mark.parametrize(
    ("payload", "late_s", "passes"),
    [
        (b'{"drive-values": {"z": 0.5}, "estop": {}}', 0.0, []),
        (BOTH, 0.6, []),
        (ZERO, 0.6, ["group", "drive-values", "lights-solid"]),
        (ZERO, 2.5, ["drive-values"]),
        (QUIET, 0.6, ["soundboard-command"]),
        (SIGNED, 0.0, []),
        (b'{"mcu/spy-1/tune": {"v": 1}, "drive-values": {"z": 0.5}}', 0.0, []),  # an MCU whose commands may be private
        (b'{"mcu/spy-1/tune": {"v": 1}, "drive-values": {"z": 0}}', 0.0, ["drive-values"]),
    ],
)
def test_of_a_bad_or_late_group_passes_what_ends_something(
    start: Start, payload: bytes, late_s: float, passes: list[str]
) -> None:
    world = start()
    world.uplink.late_s = late_s
    world.remote.publish(GROUP, payload)
    world.run(0.1)
    assert [metric for metric, _ in arrived(world)] == passes


def test_a_scripts_zero_passes_as_a_persons(start: Start) -> None:
    world = start()
    world.remote.publish(GROUP, SIGNED_ZERO)
    world.run(0.1)
    assert all("run" not in payload for _, payload in arrived(world))
    assert len(arrived(world)) == 3


def test_a_retained_group_is_stale(start: Start) -> None:
    world = start()
    world.remote.publish(GROUP, BOTH, retain=True)
    world.run(0.1)
    assert arrived(world) == []
    assert world.service.forwarder.counters[f"remote: {Drop.STALE.value}"] == 1


@pytest.mark.parametrize(
    ("suffix", "payload", "passes"),
    [
        (DRIVE, b'{"z": 0.5, "group": true}', False),
        ("incoming/lights-solid", b'{"r": 1, "group": true}', False),
        (DRIVE, b'{"z": 0, "group": true}', True),
        (DRIVE, b'{"z": 0.5}', True),
        (SOUND, b'{"action": "stop", "group": true}', True),
    ],
)
def test_marked_copies_from_outside_are_refused_but_no_zero(
    start: Start, suffix: str, payload: bytes, passes: bool
) -> None:
    world = start()
    world.remote.publish(suffix, payload)
    world.run(0.1)
    assert world.local.payloads(suffix) == ([payload] if passes else [])


def test_a_dated_group_tells_its_age(start: Start) -> None:
    world = start("thin")
    now = 1_000_000
    dated = b'{"drive-values": {"z": 0.5, "key": "0badf00d", "t": %d}, "lights-solid": {"r": 1}}'
    for sent_ms, passes in ((now, 3), (now - 2000, 0)):  # the second was sent two seconds before, and comes now
        world.local.seen.clear()
        world.remote.publish(GROUP, dated % sent_ms)
        world.run(0.1)
        assert len(arrived(world)) == passes


def test_lines_whose_wheels_have_other_topics_exclude_groups() -> None:
    lines = {"enabled": True, "serial": {"port": "/dev/a"}}
    arm = {"serial": {"port": "/dev/b"}, "topics": {"drive_values": "pebble/robots/rover/incoming/arm"}}
    with pytest.raises(ConfigError, match=r"link\.groups"):
        make_config(serial={**lines, "instances": {"arm": arm}}, link={"groups": True})


@pytest.mark.parametrize(
    ("serial", "on", "listed"),
    [
        ({"enabled": True, "serial": {"port": "/dev/a"}}, True, ["drive-values", "lights-solid", "lights-flash"]),
        ({"enabled": True, "serial": {"port": "/dev/a"}}, False, None),
    ],
)
def test_capabilities_list_what_a_robot_takes_in_a_group(serial: dict[str, Any], on: bool, listed: Any) -> None:
    config = make_config(serial=serial, link={"groups": on})
    assert capabilities(config, Addresses(config)).get("groups") == listed


# -- what may be in one, and what its copies are


def test_what_may_be_in_a_group_is_a_table() -> None:
    """A member that is added must also be one that a driver may send by itself: pebble/extensions/fleet/roles.py."""
    assert {channel.metric for channel in groups.MEMBERS} == {
        "drive-values", "lights-solid", "lights-flash", "soundboard-command", "outlets/{outlet}/power",
        "mcu/{uid}/{name}",
    }  # fmt: skip


ALL_MEMBERS = (
    b'{"drive-values": {"x": -0.25, "z": 0.5, "valid_ms": 400}, "lights-solid": {"r": 0.5},'
    b' "outlets/lamp/power": {"on": true}, "mcu/abc/arm": {"angle": 3}, "soundboard-command": {"action": "stop"}}'
)


def test_copies_are_marked_where_the_owner_of_a_line_takes_the_group() -> None:
    copies = {member.metric: copy_of(member) for member in groups.decode(ALL_MEMBERS)}
    marked = {metric for metric, copy in copies.items() if is_marked(copy)}
    assert marked == {"drive-values", "lights-solid", "mcu/abc/arm"}
    assert copies["outlets/lamp/power"] == b'{"on":true}'


def test_the_sender_is_in_each_member_and_no_claim() -> None:
    raw = b'{"by": "otto", "drive-values": {"z": 1, "by": "eve", "group": true}, "lights-solid": {}}'
    assert [member.payload for member in groups.decode(raw)] == [b'{"z":1,"by":"otto"}', b'{"by":"otto"}']


@pytest.mark.parametrize(
    "raw",
    [
        b'{"drive-values": {"z": 0.1}, "\\u0064rive-values": {"z": 0.9}, "lights-solid": {"r": 1}}',
        b'{"drive-values": {"z": 0.1, "\\u007a": 0.9}}',
        b'{"drive-values": {"z": 0.5}, "estop": {}}',
        b'{"drive-values": {"z": 0.5}, "group": {"lights-solid": {}}}',
        b'{"drive-values": {"x": 1e999}, "lights-solid": {"r": 1}}',
        b'{"drive-values": {"z": 0.5}, "mcu/a/b/c": {}}',
        b'{"drive-values": {"z": 0.5}, "outlets/1/power": {"on": 1}}',
        b'{"drive-values": {"z": 0.5, "valid_ms": 0}, "lights-solid": {"r": 1}}',
        b'{"drive-values": {"z": 0.5, "source": "autonomy"}}',
        b'{"lights-solid": {"r": 1}, "lights-flash": {"r": 1}}',
        b"{}",
        b"",
        b'{"drive-values":' + b"[" * 500 + b"]" * 500 + b"}",
        b'{"lights-solid": {"r": 1' + b" " * 2048 + b"}}",
        b"{" + b", ".join(b'"outlets/%d/power": {"on": true}' % number for number in range(9)) + b"}",
    ],
)  # fmt: skip
def test_a_group_with_a_bad_member_is_refused(raw: bytes) -> None:
    with pytest.raises(PayloadError):
        groups.decode(raw)


@pytest.mark.parametrize(
    ("raw", "marked"),
    [
        (b'{"z": 1, "group": true}', True),
        (b'{"z": 1, "gr\\u006fup": true}', True),
        (b'{"value": {"z": 1, "group": true}}', True),
        (b'{"group": ', False),
        (b'{"z": 1, "by": "group", "value": 1}', False),
    ],
)
def test_marks_are_found_however_they_are_written(raw: bytes, marked: bool) -> None:
    assert is_marked(raw) is marked
