"""The level named: who sent a message to the robot, by its topic; and what passes without a name."""

from __future__ import annotations

import json

import pytest

from pebble.contract import CHANNELS, CONTROL, DRIVE, ESTOP, GROUP, INCOMING, Channel, codec, groups
from pebble.extensions.fleet.names import CheckedNames
from pebble.extensions.fleet.roles import WRITES, Right
from pebble.forwarding.names import Signed
from pebble.forwarding.routing import Drop, Side
from pebble.forwarding.subjects import Subjects
from pebble.transports import Message
from tests.forwarding.virtual import World
from tests.services.mqtt_bridge.bridge_rig import BASE, make_config

SUBJECTS = Subjects(make_config())
NAMES = {strangers: CheckedNames(BASE, SUBJECTS, strangers) for strangers in ("drive", "free", "refuse")}
KEYED = '{"x":0,"z":0.5,"key":"0badf00d"%s}'
DEEP = b'{"a":' * 3000 + b"{}" + b"}" * 3000
MOVE, ZERO = b'{"x":0,"z":0.5}', b'{"x":0,"z":0}'


def sign(suffix: str, payload: bytes, strangers: str = "refuse", **flags: bool) -> Signed | Drop:
    names = NAMES[strangers]
    message = Message(f"{BASE}/incoming/{suffix}", payload, **flags)
    return names.sign(names[message.topic], message)


def passes(suffix: str, payload: bytes, strangers: str = "refuse") -> bool:
    return isinstance(sign(suffix, payload, strangers), Signed)


class TestSign:
    @pytest.mark.parametrize(
        ("suffix", "payload", "signed", "by"),
        [
            ("drive-values", KEYED % "", KEYED % ',"by":"ann"', "ann"),
            ("drive-values", KEYED % ',"by":"otto"', KEYED % ',"by":"ann/otto"', "ann/otto"),
            ("drive-values", KEYED % ',"by":"Zoë <b>/"', KEYED % ',"by":"ann/zo___b_/"', "ann/zo___b_/"),
            ("drive-values", KEYED % ',"by":["otto"]', KEYED % ',"by":"ann"', "ann"),
            ("drive-values", KEYED % ',"by":"otto","b\\u0079":"ada"', KEYED % ',"by":"ann/ada"', "ann/ada"),
            ("drive-values", '{"by":"otto","value":{"z":1}}', '{"value":{"z":1,"by":"ann"}}', "ann"),
            ("drive-values", '\ufeff {"z":1}\0 }', '{"z":1,"by":"ann"}', "ann"),
            ("control", '{"id":"3f2a91c0","by":"%s"}' % ("x" * 1000), '{"id":"3f2a91c0","by":"ann/%s"}' % ("x" * 36),
             "ann/" + "x" * 36),
            ("estop", '{"stop":"0123456789abcdef","by":"otto"}', '{"stop":"0123456789abcdef","by":"ann/otto"}',
             "ann/otto"),
            *(("estop", garbage, garbage, "ann") for garbage in ("stop!", "[1]", "")),
            ("autonomy-command", '\x01{"file":"a"}\x7f', '{"file":"a","by":"ann"}', "ann"),
            ("front-camera", "true", "true", "ann"),
            ("flags/mqtt-video", '{"value": true, "by": "otto"}', '{"value": true, "by": "otto"}', "ann/otto"),
            ("flags/reboot", " true", " true", "ann"),
            ("arm/wave", '{"a":1}', '{"a":1,"by":"ann"}', "ann"),
            ("arm/wave", "hello", "hello", "ann"),
        ],
    )  # fmt: skip
    def test_an_accounts_message_has_its_sender_in_it_and_no_name_in_its_topic(
        self, suffix: str, payload: str, signed: str, by: str
    ) -> None:
        found = sign(f"by/ann/{suffix}", payload.encode())
        assert isinstance(found, Signed)
        assert (found.message.topic, found.message.payload.decode(), found.by) == (
            f"{BASE}/incoming/{suffix}", signed, by
        )  # fmt: skip

    @pytest.mark.parametrize("channel", [one for one in CHANNELS if one.direction == INCOMING])
    @pytest.mark.parametrize("payload", [b"true", b"[]", b"", b"{", b"{}garbage", b'{"a":1}\xff', DEEP])
    def test_what_no_reader_takes_for_an_object_does_not_pass_as_one(self, channel: Channel, payload: bytes) -> None:
        """What would pass without a name in it is either no object for any reader, or refused by all of them."""
        found = sign(f"by/ann/{channel.metric.replace('{', '').replace('}', '')}", payload)
        assert found is Drop.UNREADABLE or (isinstance(found, Signed) and found.message.payload == payload)
        assert (found is Drop.UNREADABLE) >= (channel in (DRIVE, CONTROL))

    def test_a_group_has_one_sender_and_no_key_twice(self) -> None:
        lights = b'"lights-solid": {}}'
        found = sign("by/ann/group", b'{"drive-values": {"z": 1}, ' + lights)
        assert isinstance(found, Signed)
        assert {member.payload for member in groups.decode(found.message.payload)} == {
            b'{"z":1,"by":"ann"}', b'{"by":"ann"}'
        }  # fmt: skip
        assert sign("by/ann/group", b'{"lights-solid": {"r": 1}, ' + lights) is Drop.UNREADABLE

    @pytest.mark.parametrize("suffix", ["drive-values", "flags/mqtt-video"])
    @pytest.mark.parametrize("flag", ["retain", "retain_requested"])
    def test_nothing_is_retained_below_a_name(self, suffix: str, flag: str) -> None:
        assert sign(f"by/ann/{suffix}", b'{"z":0}', **{flag: True}) is Drop.STALE


class TestWithoutName:
    @pytest.mark.parametrize("strangers", ["drive", "free"])
    def test_strangers_may_do_what_drivers_and_viewers_do(self, strangers: str) -> None:
        may = {one for right in (Right.LOOK, Right.DRIVE) for one in WRITES[right]}
        incoming = [one for one in CHANNELS if one.direction == INCOMING and one is not ESTOP]
        plain = {one: one.metric.replace("{", "").replace("}", "") for one in incoming}
        bodies = {GROUP: b'{"lights-solid": {}}'}  # what is no group has no name either
        assert {one for one in incoming if passes(plain[one], bodies.get(one, b'{"z":1}'), strangers)} == may
        assert not [one for one in incoming if one is not DRIVE and passes(plain[one], b'{"z":1}')]

    @pytest.mark.parametrize(
        ("suffix", "payload", "strangers", "signed"),
        [
            ("drive-values", '{"z":1,"by":"otto"}', "free", '{"z":1,"by":"-"}'),
            ("drive-values", '{"z":0,"by":"otto","valid_ms":0}', "refuse", '{"z":0,"valid_ms":0,"by":"-"}'),
            ("drive-values", '{"value":{"x":"0"}}', "refuse", '{"value":{"x":"0","by":"-"}}'),
            ("drive-values", '{"z":0.001}', "refuse", None),
            ("drive-values", "nothing", "refuse", None),
            ("control", '{"id":"3f2a91c0","by":"ann"}', "free", '{"id":"3f2a91c0","by":"-"}'),
            ("control", '{"id":"3f2a91c0","want":"release"}', "refuse", None),
            ("estop", '{"by":"otto"}', "refuse", '{"by":"otto?"}'),
            ("estop", '{"by":"otto?","value":{"by":"otto??"}}', "free", '{"by":"otto?","value":{"by":"otto?"}}'),
            ("estop", '{"by":"%s"}' % ("ö" * 99), "drive", '{"by":"%s?"}' % ("ö" * 31)),
            *(("estop", same, "refuse", same) for same in ("?", '{"by": ""}', '{"by": 7}')),
            *((f"{names}estop", '{"by":"ann"}', "refuse", '{"by":"ann?"}')
              for names in ("by/Ann/", "by//", "by/-/", "by/ann/by/otto/", f"by/{'a' * 33}/")),
            ("by/Ann/drive-values", '{"z":0}', "drive", None),
            ("by/Ann/mcu/u1/estop", "{}", "drive", None),
            ("estop-reset", '{"boot":"a","count":1}', "drive", None),
            ("arm/wave", '{"z":0}', "drive", None),
        ],
    )  # fmt: skip
    def test_what_passes_is_nobodys(self, suffix: str, payload: str, strangers: str, signed: str | None) -> None:
        found = sign(suffix, payload.encode(), strangers)
        topic = f"{BASE}/incoming/{suffix.rpartition('/')[2] if suffix.startswith('by/') else suffix}"
        expected = Drop.UNNAMED if signed is None else (topic, signed.encode(), "-")
        assert expected == (
            found if isinstance(found, Drop) else (found.message.topic, found.message.payload, found.by)
        )


class TestTopics:
    @pytest.mark.parametrize(
        ("topic", "foreign"),
        [
            *(
                (f"{BASE}/incoming/by/{one}", Drop.MISNAMED)
                for one in ("ann/by/otto/x", "Ann/x", "-/x", "estop", "ann/")
            ),
            *((topic, Drop.FOREIGN) for topic in ("pebble/robots/other/incoming/by/ann/estop", f"{BASE}/x")),
        ],
    )
    def test_a_name_that_no_account_can_have_is_none_and_other_topics_are_not_this_robots(
        self, topic: str, foreign: Drop
    ) -> None:
        sender = NAMES["drive"][topic]
        assert (sender.account, sender.subject, sender.foreign) == ("-", None, foreign)

    def test_what_is_remembered_of_invented_topics_is_bounded(self) -> None:
        names = CheckedNames(BASE, SUBJECTS, "refuse")
        for number in range(10_000):
            assert names[f"{BASE}/incoming/by/ann/junk{number}"].account == "ann"
        assert len(names) <= 4096


# -- the bridge in virtual time

STOP, REBOOT = "estop", "flags/reboot"
FLAG, NAMED_FLAG = "incoming/flags/mqtt-video", "incoming/by/ann/flags/mqtt-video"


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    return World("bridge", monkeypatch)


def start(world: World, strangers: str = "refuse") -> None:
    world.run()
    world.start(security={"level": "named", "strangers": strangers}, remote_mqtt={"host": "127.0.0.1", "port": 1884})
    world.run()


def received(world: World, suffix: str, *payloads: bytes, retain: bool = False) -> list[bytes]:
    """What the robot's programs receive of it, on the topic without a name."""
    plain = f"incoming/{suffix.removeprefix('by/ann/')}"
    before = len(world.local.on(plain))
    for payload in payloads:
        world.remote.publish(f"incoming/{suffix}", payload, retain=retain)
    world.run(1)
    return world.local.payloads(plain)[before:]


def test_what_passes_and_what_does_not(world: World) -> None:
    start(world)
    assert received(world, "by/ann/drive-values", MOVE) == [b'{"x":0,"z":0.5,"by":"ann"}']
    assert received(world, "drive-values", MOVE, ZERO) == [b'{"x":0,"z":0,"by":"-"}']
    script = b'{"source":"autonomy","run":5,%s'
    (passed,) = received(world, "by/ann/drive-values", script % MOVE[1:], script % ZERO[1:])
    assert json.loads(passed) == {"x": 0, "y": 0, "z": 0, "by": "ann"}, "a script on the robot has no account"
    assert received(world, "by/ann/lights-solid", b'{"g":1}') == [b'{"g":1,"by":"ann"}']
    assert received(world, "lights-solid", b'{"g":1}') == []
    assert [message.topic for message in world.local.seen if "/by/" in message.topic] == []
    dropped = world.service.dropped()
    assert (dropped["unnamed"], dropped["signed"], dropped["misnamed"]) == (2, 1, 0)


def test_what_has_no_name_takes_no_place_of_what_has_one(world: World) -> None:
    start(world)
    assert received(world, REBOOT, *[b"true"] * 15) == []
    assert received(world, f"by/ann/{REBOOT}", b"true") == [b"true"]


class TestStops:
    def test_each_passes_with_and_without_a_name(self, world: World) -> None:
        start(world)
        press = b'{"stop":"00000000000000a1","by":"otto"}'
        claimed = press.replace(b"otto", b"otto?")
        assert {*received(world, STOP, press)} == {claimed}  # over both connections
        for names in ("Ann", "a/by/b"):
            world.remote.publish(f"incoming/by/{names}/estop", press)
        world.run(1)
        assert {*world.local.payloads("incoming/estop")} == {claimed}
        assert world.service.dropped()["misnamed"] == 0
        named = b'{"stop":"00000000000000a1","by":"ann/otto"}'
        (unread,) = {*received(world, "by/ann/estop", press, b"?")} - {named}
        assert codec.decode(ESTOP, unread).by == "ann"
        assert {*received(world, "by/ann/estop", press, retain=True)} == {named}  # live: passes

    def test_no_transport_skips_one_below_a_name(self, world: World) -> None:
        start(world)
        for metric, skipped in (("by/ann/estop", False), ("by/ann/x", True), ("by/a/by/b/estop", False)):
            topic = f"{BASE}/incoming/{metric}".encode()
            assert world.service.forwarder.skips_retained(Side.REMOTE, topic) == skipped, metric
            assert world.uplink.policy.is_stop(topic.decode()) == (not skipped)

    def test_a_retained_one_stops_nothing(self, world: World) -> None:
        for suffix in ("incoming/estop", "incoming/by/ann/estop"):
            world.remote.publish(suffix, b"old", retain=True)
        start(world)
        assert world.local.payloads("incoming/estop") == []


class TestFlags:
    """A flag by name is changed as if it had been changed on the robot: on both sides, where the robot's own counts."""

    @pytest.mark.parametrize(
        "history",
        [
            "",
            "local-forgets stop start remote-forgets",
            "cut remote-forgets mend",
            "stop older start",
            "older cut mend",
        ],
    )
    def test_it_stays_on_both_sides(self, world: World, history: str) -> None:
        start(world)
        for value in (b"false", b"true"):
            world.remote.publish(NAMED_FLAG, value)
            world.run()
            assert world.retained(FLAG) == (value, value)
        words = {
            "start": lambda: start(world),
            **world.interruptions(),
            #: The remote broker was restored from an earlier save: it retains the older value.
            "older": lambda: world.remote.publish(FLAG, b"false", retain=True, remember=False),
        }
        for word in history.split():
            words[word]()
            world.run(35)
        assert world.retained(FLAG) == (b"true", b"true")

    def test_without_a_name_it_changes_nothing_unless_strangers_may(self, world: World) -> None:
        start(world)
        world.remote.publish(FLAG, b"true", retain=True)
        world.run()
        assert world.retained(FLAG)[0] is None
        world.stop()
        start(world, "free")
        world.remote.publish(FLAG, b"false", retain=True)
        world.remote.publish("incoming/flags/remote-mirror", b"true", retain=True)
        world.run()
        assert world.retained(FLAG) == (b"false", b"false")
        assert world.retained("incoming/flags/remote-mirror")[0] is None
        assert not world.service.forwarder.mirroring.on
