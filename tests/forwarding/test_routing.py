"""Table A.1 as a pure function, row by row, and the same machinery with the mirror's table."""

from __future__ import annotations

from typing import Any

import pytest

from pebble.config import Config, parse
from pebble.contract import CHANNELS, INCOMING, OUTGOING
from pebble.forwarding.routing import MIRROR, TABLE_A1, Drop, Forward, Rules, Side, route
from pebble.forwarding.subjects import Subjects
from pebble.transports import Message, QoS
from pebble.transports.topics import matches
from tests.kit.configs import at
from tests.services.mqtt_bridge.bridge_rig import BASE, make_config

LOCAL, REMOTE = Side.LOCAL, Side.REMOTE
SUBJECTS = Subjects(make_config())


def routed(
    side: Side,
    suffix: str,
    *,
    rules: Rules = TABLE_A1,
    subjects: Subjects = SUBJECTS,
    qos: int = 1,
    retain: bool = False,
    retain_requested: bool | None = False,
    mirroring: bool = False,
) -> Forward | Drop:
    topic = suffix if suffix.startswith("/") else f"{BASE}/{suffix}"
    message = Message(topic.removeprefix("/"), b"{}", QoS(qos), retain, True if retain else retain_requested)
    return route(rules, side, subjects[message.topic], message, mirroring=mirroring)


def forward(qos: int = 1, *, retain: bool = False, urgent: bool = False) -> Forward:
    return Forward(QoS(qos), retain, urgent)


COMMAND = forward(urgent=True)
DRIVE = Forward(QoS.DELIVERED, retain=False, urgent=True, unsigned=True, stamped=True)  # from outside
FLAG = forward(retain=True, urgent=True)
ACTION = forward(urgent=True)

FLAGS = ("incoming/flags/remote-mirror", "incoming/flags/mqtt-audio", "incoming/flags/mqtt-video")
ACTIONS = ("incoming/flags/reboot", "incoming/flags/service-restart", "incoming/flags/git-pull")
COMMANDS = (
    *("incoming/drive-values", "incoming/estop", "incoming/estop-reset", "incoming/lights-solid"),
    *("incoming/lights-flash", "incoming/front-camera", "incoming/audio", "incoming/soundboard-command"),
    *("incoming/autonomy-command", "incoming/outlets/o1/power", "incoming/mcu/imu-1/reset", "incoming/mip-raw"),
)


NIGHT, STRANGE = ("incoming/flags/night",), ("incoming/strange",)
OUT = tuple(f"outgoing/{one}" for one in ("status", "wheel-odometry", "somebody/elses/metric", "heartbeat"))
REQUESTED, RETAINED, HIDDEN = {"retain_requested": True}, {"retain": True}, {"retain_requested": None}
Row = tuple[Side, tuple[str, ...], dict[str, Any], Forward | Drop]
#: By its rows: the side, topics, how they are published, and what becomes of it, whether or not remote-mirror is on.
A1: list[Row] = [
    # 1: outgoing/# is always forwarded to remote, same QoS, retained as published
    *((LOCAL, OUT, {"qos": qos}, forward(qos)) for qos in (0, 1)),
    *((LOCAL, OUT, {"qos": qos, **REQUESTED}, forward(qos, retain=True)) for qos in (0, 1)),
    *((LOCAL, ("outgoing/capabilities",), how, forward(retain=True)) for how in (RETAINED, HIDDEN)),
    (LOCAL, ("outgoing/wheel-odometry", "outgoing/strange"), HIDDEN, forward()),  # the contract knows
    (LOCAL, ("outgoing/sensors/imu-fast",), {"qos": 0}, Drop.STAYS),
    (LOCAL, ("outgoing/front-camera", "outgoing/audio"), {"qos": 0}, Drop.MEDIA),
    # 2: incoming/# is always forwarded to local, except incoming/audio-stream
    (REMOTE, COMMANDS[1:], {}, COMMAND),
    *((REMOTE, COMMANDS[:1], how, DRIVE) for how in ({}, {"qos": 0}, HIDDEN)),
    (REMOTE, STRANGE, {"qos": 0}, forward(0, urgent=True)),
    (REMOTE, ACTIONS, {}, ACTION),
    *((REMOTE, FLAGS, how, FLAG) for how in ({}, REQUESTED, HIDDEN, RETAINED)),
    *((REMOTE, NIGHT, how, FLAG) for how in (REQUESTED, RETAINED)),
    (REMOTE, NIGHT, {}, forward(urgent=True)),
    *((side, ("incoming/audio-stream",), {"qos": 0}, Drop.MEDIA) for side in Side),
    # 3: outgoing/# is never forwarded back into local
    *((REMOTE, (*OUT, "outgoing/online", "outgoing/logs"), how, Drop.ONE_WAY) for how in ({}, RETAINED)),
    # 4: incoming/flags/# is always mirrored to remote
    (LOCAL, FLAGS, {}, FLAG),
    (LOCAL, ACTIONS, {}, ACTION),
    (LOCAL, NIGHT, REQUESTED, FLAG),
    # What happens once is never forwarded if it is retained, or was published to be retained
    *((side, (*COMMANDS, *ACTIONS), how, Drop.STALE) for side in Side for how in (RETAINED, REQUESTED)),
]
#: On the robot's own broker: everything both ways, fast topics included; media not.
ON_THE_ROBOT: list[Row] = [
    *((side, ("outgoing/status",), REQUESTED, forward(retain=True)) for side in Side),
    *((side, ("outgoing/sensors/imu-fast", "outgoing/strange"), {"qos": 0}, forward(0)) for side in Side),
    *((side, COMMANDS, {}, COMMAND) for side in Side),
    *((side, ACTIONS, {}, ACTION) for side in Side),
    *((side, FLAGS, {}, FLAG) for side in Side),
    *((side, ("outgoing/front-camera", "outgoing/audio", "incoming/audio-stream"), {}, Drop.MEDIA) for side in Side),
    *((side, (*COMMANDS, *ACTIONS), how, Drop.STALE) for side in Side for how in (RETAINED, REQUESTED)),
]


@pytest.mark.parametrize("mirroring", [False, True])
@pytest.mark.parametrize(
    ("rules", "row"), [*((TABLE_A1, row) for row in A1), *((MIRROR, row) for row in ON_THE_ROBOT)], ids=lambda _: ""
)
def test_tables(rules: Rules, row: Row, mirroring: bool) -> None:
    side, suffixes, how, expected = row
    found = {suffix: routed(side, suffix, rules=rules, mirroring=mirroring, **how) for suffix in suffixes}
    assert found == dict.fromkeys(suffixes, expected)


def test_every_channel_that_may_leave_leaves() -> None:
    leaving = [c for c in CHANNELS if c.direction == OUTGOING and c.remote and c.bridged]
    assert {type(routed(LOCAL, c.suffix.format(uid="u", name="n", outlet="o1", owner="mcu"))) for c in leaving} == {
        Forward
    }


@pytest.mark.parametrize("suffix", COMMANDS)
def test_local_commands_are_mirrored_only_while_remote_mirror_is_on(suffix: str) -> None:
    """Row 5 of Table A.1."""
    assert routed(LOCAL, suffix) is Drop.NOT_MIRRORED
    assert routed(LOCAL, suffix, mirroring=True) == COMMAND


@pytest.mark.parametrize("rules", [TABLE_A1, MIRROR], ids=["bridge", "mirror"])
@pytest.mark.parametrize(
    "topic",
    [
        *("/pebble/robots/goob/incoming/drive-values", "/pebble/robots/rover2/outgoing/status"),
        *("/pebble/robots/rover", f"/{BASE}/incoming", f"/{BASE}/elsewhere/x"),
        *(f"/{BASE}/incoming/{way}/goob/drive-values" for way in ("from", "to")),
        *(f"/{BASE}/outgoing/neighbours/fred/sensors/imu", f"/{BASE}/incoming/from/goob/by/ann/estop"),
    ],
)
def test_other_topics_never_pass(topic: str, rules: Rules) -> None:
    assert {routed(side, topic, rules=rules, mirroring=True) for side in Side} == {Drop.FOREIGN}


RENAMED = {
    "services.mqtt_bridge.topics.reboot": (ACTION, LOCAL),
    "services.mqtt_bridge.topics.mqtt_audio": (FLAG, REMOTE),
    "services.serial_mcu_bridge.topics.drive_values": (DRIVE, REMOTE),
    "services.serial_mcu_bridge.topics.high_rate": (Drop.STAYS, LOCAL),
    "services.mqtt_bridge.media.audio_receiver.topic": (Drop.MEDIA, REMOTE),
}


def config_with(path: str, value: Any) -> Config:
    return parse({"robot": {"id": "rover"}, **at(path, value)}, folder=make_config().folder, env={})


class TestRenamedTopics:
    @pytest.mark.parametrize("path", RENAMED)
    def test_follow_their_channel(self, path: str) -> None:
        expected, side = RENAMED[path]
        subjects = Subjects(config_with(path, "site/renamed"))
        assert routed(side, "/site/renamed", subjects=subjects) == expected
        assert any(matches(filter_, "site/renamed") for filter_ in subjects.filters(INCOMING, OUTGOING))

    def test_an_instances_names_count_too(self) -> None:
        instance = {"enabled": True, "serial": {"port": "/dev/null"}, "topics": {"drive_values": "arm/drive"}}
        subjects = Subjects(config_with("services.serial_mcu_bridge.instances", {"arm": instance}))
        assert routed(REMOTE, "/arm/drive", subjects=subjects) == DRIVE
        assert routed(REMOTE, "incoming/drive-values", subjects=subjects) == DRIVE
        assert "arm/drive" in subjects.filters(INCOMING)


def test_filters_never_overlap_and_memory_of_strangers_is_bounded() -> None:
    assert SUBJECTS.filters(INCOMING) == [f"{BASE}/incoming/#"]
    assert SUBJECTS.filters(INCOMING, OUTGOING) == [f"{BASE}/incoming/#", f"{BASE}/outgoing/#"]
    subjects = Subjects(config_with("services.mqtt_bridge.topics.reboot", f"{BASE}/incoming/again"))
    assert subjects.filters(INCOMING) == [f"{BASE}/incoming/#"]
    for number in range(10_000):
        assert subjects[f"{BASE}/outgoing/n{number}"] is not None
    assert len(subjects) < 5000
