"""The contract is complete, well-formed, and the only place where a topic is spelled; identities and names."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pebble import contract as c
from pebble.contract import CHANNELS, INCOMING, OUTGOING, Channel, Kind, channel_of
from pebble.contract.identity import Identity, ParsedTopic, parse_topic
from pebble.contract.names import with_name, without_name
from pebble.contract.payloads import Payload
from pebble.errors import ConfigError
from pebble.transports.topics import check_topic
from tests.support import ROOT

BASE = "pebble/robots/goob"

# Written out on purpose: this is what the paper and the original's wire say, not what our contract says. Its tables 3.1
# and A.2 name nothing that is not in these.
TABLE_A3 = [
    "incoming/drive-values", "incoming/lights-solid", "incoming/lights-flash", "incoming/front-camera",
    "incoming/audio", "incoming/audio-stream", "incoming/soundboard-command", "incoming/autonomy-command",
    "incoming/flags/remote-mirror", "incoming/flags/mqtt-audio", "incoming/flags/mqtt-video", "incoming/flags/reboot",
    "incoming/flags/git-pull",
]  # fmt: skip
TABLE_A4 = [
    "outgoing/online", "outgoing/capabilities", "outgoing/logs", "outgoing/touch-sensors", "outgoing/charging-status",
    "outgoing/charging-level", "outgoing/front-camera", "outgoing/audio", "outgoing/soundboard-files",
    "outgoing/soundboard-status", "outgoing/autonomy-files", "outgoing/autonomy-status", "outgoing/wheel-odometry",
    "outgoing/apriltag-locations", "outgoing/apriltag-data", "outgoing/video-overlays",
]  # fmt: skip
TABLE_A5 = ["outgoing/heartbeat", "outgoing/status", "outgoing/charging-level"]
ORIGINALS_WIRE = [
    "incoming/flags/service-restart", "incoming/mcu/goob-imu-nano/led", "incoming/outlets/o1/power",
    "incoming/mip-raw", "outgoing/sensors/imu-fast", "outgoing/sensors/imu", "outgoing/mcu/goob-imu-nano/describe",
    "outgoing/mcu/goob-imu-nano/imu_fast", "outgoing/outlets/o4/status", "outgoing/localization-pose",
    "outgoing/navigation-status", "outgoing/navigation-goal", "outgoing/navigation/local-plan",
    "outgoing/navigation/global-plan", "outgoing/diagnostics",
]  # fmt: skip

TABLE_A6 = {
    "services.launcher.capabilities.topic": "outgoing/capabilities",
    "services.launcher.logs.topic": "outgoing/logs",
    "services.mqtt_bridge.topics.remote_mirror": "incoming/flags/remote-mirror",
    "services.mqtt_bridge.topics.mqtt_audio": "incoming/flags/mqtt-audio",
    "services.mqtt_bridge.topics.mqtt_video": "incoming/flags/mqtt-video",
    "services.mqtt_bridge.topics.reboot": "incoming/flags/reboot",
    "services.mqtt_bridge.topics.service_restart": "incoming/flags/service-restart",
    "services.mqtt_bridge.topics.git_pull": "incoming/flags/git-pull",
    "services.mqtt_bridge.topics.audio_control": "incoming/audio",
    "services.mqtt_bridge.topics.video_control": "incoming/front-camera",
    "services.mqtt_bridge.heartbeat.topic": "outgoing/online",
    "services.mqtt_bridge.media.video_publisher.topic": "outgoing/front-camera",
    "services.mqtt_bridge.media.video_publisher.overlays_topic": "outgoing/video-overlays",
    "services.mqtt_bridge.media.audio_publisher.topic": "outgoing/audio",
    "services.mqtt_bridge.media.audio_receiver.topic": "incoming/audio-stream",
    "services.serial_mcu_bridge.topics.drive_values": "incoming/drive-values",
    "services.serial_mcu_bridge.topics.lights_solid": "incoming/lights-solid",
    "services.serial_mcu_bridge.topics.lights_flash": "incoming/lights-flash",
    "services.serial_mcu_bridge.topics.touch_sensors": "outgoing/touch-sensors",
    "services.serial_mcu_bridge.topics.charging_status": "outgoing/charging-status",
    "services.serial_mcu_bridge.topics.charging_level": "outgoing/charging-level",
    "services.serial_mcu_bridge.topics.high_rate": "outgoing/sensors/imu-fast",
    "services.serial_mcu_bridge.topics.low_rate": "outgoing/sensors/imu",
    "services.soundboard_handler.topics.command": "incoming/soundboard-command",
    "services.soundboard_handler.topics.files": "outgoing/soundboard-files",
    "services.soundboard_handler.topics.status": "outgoing/soundboard-status",
    "services.autonomy_manager.topics.command": "incoming/autonomy-command",
    "services.autonomy_manager.topics.files": "outgoing/autonomy-files",
    "services.autonomy_manager.topics.status": "outgoing/autonomy-status",
}

each_channel = pytest.mark.parametrize("channel", CHANNELS, ids=lambda channel: channel.suffix)


# -- complete


@pytest.mark.parametrize("suffix", sorted({*TABLE_A3, *TABLE_A4, *TABLE_A5, *ORIGINALS_WIRE}))
def test_every_topic_of_the_paper_and_of_the_original_is_a_channel(suffix: str) -> None:
    channel = channel_of(suffix)
    assert channel is not None
    assert channel.direction == suffix.split("/")[0]


def test_every_override_point_of_table_a6_belongs_to_its_channel() -> None:
    ours = {channel.override: channel.suffix for channel in CHANNELS if channel.override is not None}
    assert ours == TABLE_A6


def test_delivery_rules_are_those_of_the_wire() -> None:
    def rules(channel: Channel) -> tuple[str, int, bool]:
        return channel.direction, channel.default_qos, channel.default_retain

    assert rules(c.DRIVE) == (INCOMING, 1, False)
    assert rules(c.MQTT_VIDEO) == (INCOMING, 1, True)
    assert rules(c.REBOOT) == (INCOMING, 1, False)
    assert rules(c.AUDIO_STREAM) == (INCOMING, 0, False)
    assert rules(c.ONLINE) == (OUTGOING, 1, True)
    assert rules(c.LOGS) == (OUTGOING, 0, False)
    assert rules(c.TOUCH_SENSORS) == (OUTGOING, 1, False)
    assert rules(c.IMU_FAST) == (OUTGOING, 0, False)
    assert rules(c.CAMERA) == (OUTGOING, 0, False)


def test_local_channels_stay_on_the_robot_and_some_never_pass_the_bridge() -> None:
    inside = [channel.metric for channel in CHANNELS if not channel.remote]
    assert inside == [
        *("control-turn/{owner}", "control-vouched", "motor-power/{owner}", "sensors/imu-fast"),
        *("mcu/{uid}/local-only", "media-report/{program}"),
        *("from/{robot}/drive-values", "to/{robot}/drive-values", "neighbours/{robot}/{metric}"),
    ]
    assert {channel.suffix for channel in CHANNELS if not channel.bridged} == {
        "incoming/audio-stream", "outgoing/front-camera", "outgoing/audio",
    }  # fmt: skip


# -- well-formed


@each_channel
def test_a_channel_is_well_formed(channel: Channel) -> None:
    assert re.fullmatch(r"([a-z0-9-]+|{[a-z]+})(/([a-z0-9-]+|{[a-z]+}))*", channel.metric)
    assert channel.doc.endswith(".")
    assert channel.default_qos in (0, 1)
    assert channel.default_retain == (channel.kind in (Kind.STATE, Kind.FLAG))
    assert channel.rate_hz >= 0
    assert channel.payload in (bool, bytes) or issubclass(channel.payload, Payload)
    assert channel.synonym_of is None or channel_of(f"{channel.direction}/{channel.synonym_of}") is not None


@each_channel
def test_a_channel_is_found_by_its_own_topic(channel: Channel) -> None:
    names = dict.fromkeys(re.findall(r"{(\w+)}", channel.metric), "o1")
    topic = channel.topic(BASE, **names)
    address = parse_topic(topic)
    assert address is not None
    assert address.identity == Identity("pebble", "robots", "goob")
    assert channel_of(topic.removeprefix(BASE + "/")) is channel
    assert channel.filter(BASE) == re.sub(r"{\w+}", "+", f"{BASE}/{channel.suffix}")
    assert channel.names(topic) == names
    assert channel.names(f"{topic}/more") == {}


@pytest.mark.parametrize(
    "stranger", ["incoming/online", "outgoing/drive-values", "incoming/drive-values/x", "incoming", "", "x/audio",
                 "outgoing/mcu/a/b/c", "incoming/outlets/o1/status"],
)  # fmt: skip
def test_strangers_have_no_channel(stranger: str) -> None:
    assert channel_of(stranger) is None


# -- and spelled nowhere else

# Metrics that are ordinary words ("audio", "logs") say nothing by themselves; these do.
DISTINCTIVE = {channel.metric for channel in CHANNELS if re.search("[-/]", channel.metric)}
SPELLED = re.compile(r"(^|/)(incoming|outgoing)/[\w{+#]")


SUSPECT = re.compile("(incoming|outgoing)/|" + "|".join(map(re.escape, DISTINCTIVE)))


def spelled_topics(path: Path) -> Iterator[str]:
    """String constants that are a topic or a part of one; sentences (docstrings, help, key docs) are none."""
    source = path.read_text()
    for node in ast.walk(ast.parse(source)) if SUSPECT.search(source) else ():
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and not re.search(r"\s", node.value):
            text = node.value
            if SPELLED.search(text) or any(text == metric or text.endswith("/" + metric) for metric in DISTINCTIVE):
                yield f"{path.relative_to(ROOT)}:{node.lineno}: {text!r}"


def test_no_topic_is_spelled_outside_the_contract() -> None:
    excepted = ("channels.py", "messages.py")  # the second names operations of the page
    files = [path for folder in ("pebble", "services", "transports") for path in (ROOT / folder).rglob("*.py")]
    assert len(files) > 20
    assert [one for path in files if not str(path).endswith(excepted) for one in spelled_topics(path)] == []


@pytest.mark.parametrize(
    "topic",
    [
        *("", "pebble/infrastructure", "pebble/robots/goob/incoming", "pebble/robots/goob/incoming/"),
        *("pebble/robots/goob/sideways/online", "pebble/robots//outgoing/online", "$SYS/robots/goob/outgoing/online"),
        "/pebble/robots/goob/outgoing/online",
    ],
)
def test_other_topics_belong_to_no_robot(topic: str) -> None:
    assert parse_topic(topic) is None


@pytest.mark.parametrize("level", ["", "a/b", "a+", "#", "$a", "a$", "a\n", "a\x00", "\ufffe", "x" * 65])
def test_levels_no_topic_can_hold_are_refused(level: str) -> None:
    with pytest.raises(ConfigError, match=r"robot\.id"):
        Identity("pebble", "robots", level)


_levels = st.text(st.characters(codec="utf-8"), min_size=1, max_size=70)


@given(_levels, _levels, _levels)
def test_every_transport_carries_an_accepted_identity(system: str, type_: str, id_: str) -> None:
    try:
        identity = Identity(system, type_, id_)
    except ConfigError:
        return
    topic = check_topic(identity.outgoing("online"))
    assert parse_topic(topic) == ParsedTopic(identity, OUTGOING, "online")


# -- the sender's account in a topic


@pytest.mark.parametrize("metric", ["drive-values", "flags/mqtt-audio", "mcu/lamp/blink", "control/take"])
def test_a_name_stands_behind_incoming(metric: str) -> None:
    topic = with_name(f"{BASE}/incoming/{metric}", "ann")
    assert topic == f"{BASE}/incoming/by/ann/{metric}"
    assert without_name(topic) == ("ann", f"{BASE}/incoming/{metric}")


@pytest.mark.parametrize(
    "topic",
    [
        f"{BASE}/incoming/drive-values",
        f"{BASE}/incoming/by/ann/by/otto/drive-values",
        f"{BASE}/incoming/by/Ann/drive-values",
        f"{BASE}/incoming/by//drive-values",
        f"{BASE}/incoming/by/{'a' * 33}/drive-values",
        f"{BASE}/incoming/by/ann/",
        f"{BASE}/outgoing/by/ann/online",
        "robots/goob/incoming/by/ann/drive-values",
    ],
)
def test_other_topics_have_no_name(topic: str) -> None:
    assert without_name(topic) is None


@pytest.mark.parametrize(
    ("topic", "account"), [(f"{BASE}/outgoing/online", "ann"), (f"{BASE}/incoming/x", "Ann"), ("incoming/x", "ann")]
)
def test_a_name_that_cannot_stand_there_is_refused(topic: str, account: str) -> None:
    with pytest.raises(ValueError, match="takes no name"):
        with_name(topic, account)
