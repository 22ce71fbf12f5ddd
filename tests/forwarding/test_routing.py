"""Table A.1 as a pure function, row by row, and the same machinery with the mirror's table."""

from __future__ import annotations

from typing import Any

import pytest

from pebble.config import Config, parse
from pebble.contract import CHANNELS, INCOMING, OUTGOING, Kind
from pebble.forwarding.routing import MIRROR, TABLE_A1, Drop, Forward, Rules, Side, route
from pebble.forwarding.subjects import Subjects
from pebble.transports import Message, QoS
from pebble.transports.topics import matches
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
DRIVE = Forward(QoS.DELIVERED, retain=False, urgent=True, unsigned=True)  # from outside
FLAG = forward(retain=True, urgent=True)
ACTION = forward(urgent=True)

FLAGS = ("incoming/flags/remote-mirror", "incoming/flags/mqtt-audio", "incoming/flags/mqtt-video")
ACTIONS = ("incoming/flags/reboot", "incoming/flags/service-restart", "incoming/flags/git-pull")
COMMANDS = (
    "incoming/drive-values",
    "incoming/estop",
    "incoming/estop-reset",
    "incoming/lights-solid",
    "incoming/lights-flash",
    "incoming/front-camera",
    "incoming/audio",
    "incoming/soundboard-command",
    "incoming/autonomy-command",
    "incoming/outlets/o1/power",
    "incoming/mcu/imu-1/reset",
    "incoming/mip-raw",
)


class TestLocalOutgoing:
    """Row 1: {base}/outgoing/# is always forwarded to remote, same QoS, retained as published."""

    @pytest.mark.parametrize("qos", [0, 1])
    @pytest.mark.parametrize("retain_requested", [False, True])
    @pytest.mark.parametrize("suffix", ["outgoing/status", "outgoing/wheel-odometry", "outgoing/somebody/elses/metric"])
    def test_is_forwarded_as_published(self, suffix: str, retain_requested: bool, qos: int) -> None:
        assert routed(LOCAL, suffix, qos=qos, retain_requested=retain_requested) == forward(
            qos, retain=retain_requested
        )

    @pytest.mark.parametrize("suffix", ["outgoing/heartbeat", "outgoing/status", "outgoing/charging-level"])
    def test_compatibility_topics_too(self, suffix: str) -> None:
        assert routed(LOCAL, suffix, retain_requested=True) == forward(retain=True)

    def test_a_retained_message_stays_retained(self) -> None:
        assert routed(LOCAL, "outgoing/capabilities", retain=True) == forward(retain=True)

    def test_where_the_broker_hides_it_the_contract_knows(self) -> None:
        assert routed(LOCAL, "outgoing/capabilities", retain_requested=None) == forward(retain=True)
        assert routed(LOCAL, "outgoing/wheel-odometry", retain_requested=None) == forward(retain=False)
        assert routed(LOCAL, "outgoing/strange", retain_requested=None) == forward(retain=False)

    def test_every_channel_that_may_leave_leaves(self) -> None:
        leaving = [c for c in CHANNELS if c.direction == OUTGOING and c.remote and c.bridged]
        assert {type(routed(LOCAL, c.suffix.format(uid="u", name="n", outlet="o1", owner="mcu"))) for c in leaving} == {
            Forward
        }

    def test_what_stays_on_the_robot_stays(self) -> None:
        assert routed(LOCAL, "outgoing/sensors/imu-fast", qos=0) is Drop.STAYS

    @pytest.mark.parametrize("suffix", ["outgoing/front-camera", "outgoing/audio"])
    def test_media_goes_its_own_way(self, suffix: str) -> None:
        assert routed(LOCAL, suffix, qos=0) is Drop.MEDIA


class TestRemoteIncoming:
    """Row 2: {base}/incoming/# is always forwarded to local, except incoming/audio-stream."""

    @pytest.mark.parametrize("suffix", COMMANDS)
    @pytest.mark.parametrize("mirroring", [False, True])
    def test_commands_are_forwarded(self, suffix: str, mirroring: bool) -> None:
        expected = DRIVE if suffix == "incoming/drive-values" else COMMAND
        assert routed(REMOTE, suffix, mirroring=mirroring) == expected

    @pytest.mark.parametrize("suffix", ACTIONS)
    def test_actions_are_forwarded_but_not_retained(self, suffix: str) -> None:
        assert routed(REMOTE, suffix) == ACTION

    @pytest.mark.parametrize("suffix", FLAGS)
    @pytest.mark.parametrize("retain_requested", [None, False, True])
    def test_flags_are_forwarded_as_retained(self, suffix: str, retain_requested: bool | None) -> None:
        assert routed(REMOTE, suffix, retain_requested=retain_requested) == FLAG

    @pytest.mark.parametrize("suffix", FLAGS)
    def test_retained_flags_too(self, suffix: str) -> None:
        assert routed(REMOTE, suffix, retain=True) == FLAG

    def test_an_unknown_flag_is_retained_as_published(self) -> None:
        assert routed(REMOTE, "incoming/flags/night", retain_requested=True) == forward(retain=True, urgent=True)
        assert routed(REMOTE, "incoming/flags/night", retain=True) == forward(retain=True, urgent=True)
        assert routed(REMOTE, "incoming/flags/night", retain_requested=False) == forward(urgent=True)

    def test_a_known_command_gets_its_quality(self) -> None:
        assert routed(REMOTE, "incoming/drive-values", qos=0) == DRIVE
        assert routed(REMOTE, "incoming/strange", qos=0) == forward(0, urgent=True)

    @pytest.mark.parametrize("side", list(Side))
    @pytest.mark.parametrize("mirroring", [False, True])
    def test_the_audio_stream_is_not_bridged(self, side: Side, mirroring: bool) -> None:
        assert routed(side, "incoming/audio-stream", qos=0, mirroring=mirroring) is Drop.MEDIA


class TestRemoteOutgoing:
    """Row 3: {base}/outgoing/# is never forwarded back into local."""

    @pytest.mark.parametrize("suffix", ["outgoing/status", "outgoing/online", "outgoing/strange", "outgoing/logs"])
    @pytest.mark.parametrize("retain", [False, True])
    @pytest.mark.parametrize("mirroring", [False, True])
    def test_never(self, suffix: str, retain: bool, mirroring: bool) -> None:
        assert routed(REMOTE, suffix, retain=retain, mirroring=mirroring) is Drop.ONE_WAY


class TestLocalFlags:
    """Row 4: {base}/incoming/flags/# is always mirrored to remote."""

    @pytest.mark.parametrize("suffix", FLAGS)
    @pytest.mark.parametrize("mirroring", [False, True])
    def test_flags(self, suffix: str, mirroring: bool) -> None:
        assert routed(LOCAL, suffix, mirroring=mirroring) == FLAG

    @pytest.mark.parametrize("suffix", ACTIONS)
    def test_actions(self, suffix: str) -> None:
        assert routed(LOCAL, suffix) == ACTION

    def test_strangers(self) -> None:
        assert routed(LOCAL, "incoming/flags/night", retain_requested=True) == forward(retain=True, urgent=True)


class TestLocalIncoming:
    """Row 5: other {base}/incoming/# is mirrored only while incoming/flags/remote-mirror is true."""

    @pytest.mark.parametrize("suffix", COMMANDS)
    def test_only_while_mirroring(self, suffix: str) -> None:
        assert routed(LOCAL, suffix) is Drop.NOT_MIRRORED
        assert routed(LOCAL, suffix, mirroring=True) == COMMAND


class TestRetainedOneShots:
    """What happens once is never forwarded if it is retained, or was published to be retained."""

    @pytest.mark.parametrize("suffix", [*COMMANDS, *ACTIONS])
    @pytest.mark.parametrize("side", list(Side))
    @pytest.mark.parametrize("rules", [TABLE_A1, MIRROR], ids=["bridge", "mirror"])
    def test_neither_way(self, rules: Rules, side: Side, suffix: str) -> None:
        assert routed(side, suffix, rules=rules, retain=True, mirroring=True) is Drop.STALE
        assert routed(side, suffix, rules=rules, retain_requested=True, mirroring=True) is Drop.STALE

    def test_executed_where_the_broker_hides_it(self) -> None:
        assert routed(REMOTE, "incoming/drive-values", retain_requested=None) == DRIVE


class TestOthers:
    @pytest.mark.parametrize("rules", [TABLE_A1, MIRROR], ids=["bridge", "mirror"])
    @pytest.mark.parametrize("side", list(Side))
    @pytest.mark.parametrize(
        "topic",
        [
            "/pebble/robots/goob/incoming/drive-values",
            "/pebble/robots/rover2/outgoing/status",
            "/pebble/robots/rover",
            f"/{BASE}/incoming",
            f"/{BASE}/elsewhere/x",
            "/pebble/infrastructure",
            "/other/robots/rover/incoming/drive-values",
            "/drive-values",
        ],
    )
    def test_other_topics_never_pass(self, topic: str, side: Side, rules: Rules) -> None:
        assert routed(side, topic, rules=rules, mirroring=True) is Drop.FOREIGN


RENAMED = {
    "services.mqtt_bridge.topics.reboot": ("flags/reboot", "site/switches/reboot", ACTION, LOCAL),
    "services.mqtt_bridge.topics.service_restart": ("flags/service-restart", "site/restart", ACTION, LOCAL),
    "services.mqtt_bridge.topics.git_pull": ("flags/git-pull", "site/pull", ACTION, REMOTE),
    "services.mqtt_bridge.topics.remote_mirror": ("flags/remote-mirror", "site/mirror", FLAG, LOCAL),
    "services.mqtt_bridge.topics.mqtt_audio": ("flags/mqtt-audio", "site/a", FLAG, REMOTE),
    "services.mqtt_bridge.topics.mqtt_video": ("flags/mqtt-video", "site/v", FLAG, LOCAL),
    "services.mqtt_bridge.topics.audio_control": ("audio", "site/audio", COMMAND, REMOTE),
    "services.mqtt_bridge.topics.video_control": ("front-camera", "site/video", COMMAND, REMOTE),
    "services.serial_mcu_bridge.topics.drive_values": ("drive-values", "site/drive", DRIVE, REMOTE),
    "services.serial_mcu_bridge.topics.lights_solid": ("lights-solid", "site/solid", COMMAND, REMOTE),
    "services.serial_mcu_bridge.topics.lights_flash": ("lights-flash", "site/flash", COMMAND, REMOTE),
    "services.serial_mcu_bridge.topics.charging_level": ("charging-level", "site/volts", forward(), LOCAL),
    "services.serial_mcu_bridge.topics.charging_status": ("charging-status", "site/chg", forward(), LOCAL),
    "services.serial_mcu_bridge.topics.touch_sensors": ("touch-sensors", "site/touch", forward(), LOCAL),
    "services.serial_mcu_bridge.topics.high_rate": ("sensors/imu-fast", "site/fast", Drop.STAYS, LOCAL),
    "services.serial_mcu_bridge.topics.low_rate": ("sensors/imu", "site/imu", forward(), LOCAL),
    "services.launcher.capabilities.topic": ("capabilities", "site/caps", forward(), LOCAL),
    "services.launcher.logs.topic": ("logs", "site/logs", forward(), LOCAL),
    "services.mqtt_bridge.heartbeat.topic": ("online", "site/online", forward(), LOCAL),
    "services.mqtt_bridge.media.video_publisher.topic": ("front-camera", "site/pictures", Drop.MEDIA, LOCAL),
    "services.mqtt_bridge.media.audio_publisher.topic": ("audio", "site/sound", Drop.MEDIA, LOCAL),
    "services.mqtt_bridge.media.audio_receiver.topic": ("audio-stream", "site/talk", Drop.MEDIA, REMOTE),
    "services.soundboard_handler.topics.command": ("soundboard-command", "site/play", COMMAND, REMOTE),
    "services.autonomy_manager.topics.status": ("autonomy-status", "site/auto", forward(), LOCAL),
}


def config_with(path: str, value: Any) -> Config:
    raw: dict[str, Any] = {"robot": {"id": "rover"}}
    section = raw
    *folders, key = path.split(".")
    for name in folders:
        section = section.setdefault(name, {})
    section[key] = value
    return parse(raw, folder=make_config().folder, env={})


class TestRenamedTopics:
    @pytest.mark.parametrize("path", RENAMED)
    def test_follow_their_channel(self, path: str) -> None:
        _, topic, expected, side = RENAMED[path]
        subjects = Subjects(config_with(path, topic))
        assert routed(side, f"/{topic}", subjects=subjects) == expected
        assert any(matches(filter_, topic) for filter_ in subjects.filters(INCOMING, OUTGOING))

    def test_an_instances_names_count_too(self) -> None:
        instance = {"enabled": True, "serial": {"port": "/dev/null"}, "topics": {"drive_values": "arm/drive"}}
        subjects = Subjects(config_with("services.serial_mcu_bridge.instances", {"arm": instance}))
        assert routed(REMOTE, "/arm/drive", subjects=subjects) == DRIVE
        assert routed(REMOTE, "incoming/drive-values", subjects=subjects) == DRIVE
        assert "arm/drive" in subjects.filters(INCOMING)


class TestFilters:
    def test_of_a_robot_without_renamed_topics(self) -> None:
        assert SUBJECTS.filters(INCOMING) == [f"{BASE}/incoming/#"]
        assert SUBJECTS.filters(INCOMING, OUTGOING) == [f"{BASE}/incoming/#", f"{BASE}/outgoing/#"]

    def test_never_overlap(self) -> None:
        subjects = Subjects(config_with("services.mqtt_bridge.topics.reboot", f"{BASE}/incoming/again"))
        assert subjects.filters(INCOMING) == [f"{BASE}/incoming/#"]

    def test_memory_of_strangers_is_bounded(self) -> None:
        subjects = Subjects(make_config())
        for number in range(10_000):
            assert subjects[f"{BASE}/outgoing/n{number}"] is not None
        assert len(subjects) < 5000


class TestMirrorTable:
    """On the robot's own broker: everything both ways, fast topics included; media not."""

    @pytest.mark.parametrize("side", list(Side))
    def test_both_ways(self, side: Side) -> None:
        assert routed(side, "outgoing/status", rules=MIRROR, retain_requested=True) == forward(retain=True)
        assert routed(side, "outgoing/sensors/imu-fast", rules=MIRROR, qos=0) == forward(0)
        assert routed(side, "incoming/drive-values", rules=MIRROR) == COMMAND
        assert routed(side, "incoming/flags/reboot", rules=MIRROR) == ACTION
        assert routed(side, "incoming/flags/mqtt-video", rules=MIRROR) == FLAG
        assert routed(side, "outgoing/strange", rules=MIRROR, qos=0) == forward(0)

    @pytest.mark.parametrize("side", list(Side))
    @pytest.mark.parametrize("suffix", ["outgoing/front-camera", "outgoing/audio", "incoming/audio-stream"])
    def test_media_stays_away(self, side: Side, suffix: str) -> None:
        assert routed(side, suffix, rules=MIRROR) is Drop.MEDIA


def test_the_tables_name_every_kind() -> None:
    for rules in (TABLE_A1, MIRROR):
        named = set().union(*rules.passes.values(), *rules.mirrored.values())
        assert named == set(Kind)
