"""What of a recording may go out: the safety rules."""

from __future__ import annotations

import json
from typing import Any

import pytest

from pebble.contract import CHANNELS, INCOMING
from pebble.errors import ConfigError, TransportError
from pebble.extensions.recordings.files.recorded import Channel, Recorded
from pebble.extensions.recordings.replay.rules import Options, Outgoing, ReplayError, Rules, zero
from pebble.transports import QoS
from tests.ext.recordings.playing import FRED, GOOB, THEN_NS, Line, js, ms

EVERYTHING = Options(incoming=True)


def rules_of(options: Options, *lines: Line) -> Rules:
    return Rules(options, [Channel(number, line.topic, "json", line.metadata) for number, line in enumerate(lines)])


def sent(options: Options, line: Line, *others: Line) -> Outgoing | None:
    channel = Channel(1, line.topic, "json", line.metadata)
    return rules_of(options, line, *others).outgoing(Recorded(channel, 0, line.log_ns, 0, line.payload), 0)


def goes(options: Options, topic: str, payload: bytes = b"{}", **flags: Any) -> bool:
    return sent(options, Line(0, topic, payload, **flags)) is not None


IN, OUT, SIGNED = f"{GOOB}/incoming", f"{GOOB}/outgoing", js(x=0, z=0.5, source="autonomy", run=7)
STOP = js(stop="0123456789abcdef")
#: What never goes out, whatever is asked for.
STAYS = {
    "of a broker, or without a robot and a direction (rule 1)": [
        (topic, b"{}")
        for topic in (
            "$recorder/events", "$SYS/a/b/outgoing/x", "$share/a/b/outgoing/x", "", "logs", "home/goob/drive", GOOB,
            "pebble/infrastructure", f"{GOOB}/other/x", f"{OUT}/+", f"{OUT}/#", f"{OUT}/a\nb", f"{OUT}/{'x' * 2000}",
            "a/b/c/d/outgoing/x", "pebble/servers/s1/outgoing/driving",
        )
    ],
    "capabilities that cannot be read": [
        (f"{OUT}/capabilities", payload) for payload in (b"{", b"[]", b'{"value":[]}', b"\xff", b"{}", b"[" * 5000)
    ],
    "probes of bridges": [
        (f"{OUT}/bridge-probe", b"{}"), (f"{OUT}/charging-level", b'{"value":7}' + b" \t" * 16),
        (f"{IN}/drive-values", b"  "),
    ],
    "what switches on, stops, resets, acts for a person or is not known (rule 4)": [
        (f"{IN}/{metric}", payload)
        for payload in (b"{}", STOP)
        for metric in (
            "front-camera", "audio", "autonomy-command", "flags/mqtt-video", "flags/reboot", "flags/unknown",
            "outlets/heater/power", "mcu/ab12/motor", "mip-raw", "renamed-drive", "drive-values/2", "estop",
            "estop-reset", "estop/x", "estops", "by/anna/drive-values", "by/anna/estop", "by/anna/flags/reboot",
            "control",
        )
    ],
    "drive commands of scripts, or that cannot be judged (rule 4)": [
        (f"{IN}/drive-values", payload)
        for payload in (SIGNED, b"", b"{", b'{"x":NaN}', b'{"z":"1e999"}', b"[0.5,0.5]")
    ],
}  # fmt: skip


@pytest.mark.parametrize("what", STAYS)
def test_what_stays_away_whatever_is_asked_for(what: str) -> None:
    assert [topic for topic, payload in STAYS[what] if goes(EVERYTHING, topic, payload)] == []


# -- rule 2


@pytest.mark.parametrize("qos", [1, 2])  # which no transport has: it becomes the best
def test_rule_2_by_default_another_base(qos: int) -> None:
    found = sent(Options(), Line(0, f"{GOOB}/outgoing/sensors/imu", b"{}", qos))
    assert found is not None
    assert found.message.topic == "replay/robots/goob/outgoing/sensors/imu"
    assert found.message.qos is QoS.DELIVERED
    assert not found.message.retain
    assert rules_of(Options(), Line(0, f"{GOOB}/outgoing/logs", b"")).robots == {"replay/robots/goob": GOOB}


def test_rule_2_never_the_recorded_base() -> None:
    with pytest.raises(ReplayError, match="--base pebble is the base of pebble/robots/goob itself: choose another one"):
        goes(Options(system="pebble"), f"{GOOB}/outgoing/logs")


@pytest.mark.parametrize("system", ["", "a/b", "+", "#", "$SYS", "a" * 65, "a\n"])
def test_rule_2_a_base_is_one_level(system: str) -> None:
    with pytest.raises(ConfigError):
        rules_of(Options(system=system))


def test_two_robots_never_become_one() -> None:
    lines = [Line(0, f"{GOOB}/outgoing/logs", b""), Line(0, "test/robots/goob/outgoing/logs", b"")]
    with pytest.raises(ReplayError, match="choose one by --only 'test/robots/goob/#'"):
        rules_of(Options(), *lines)
    assert len(rules_of(Options(only=(f"{GOOB}/#",)), *lines).robots) == 1


def test_robots_that_were_not_known_at_the_start_stay_silent() -> None:
    rules = rules_of(Options(), Line(0, f"{GOOB}/outgoing/logs", b""))
    unknown = Channel(9, f"{FRED}/outgoing/logs", "json", {})
    assert rules.outgoing(Recorded(unknown, 0, THEN_NS, 0, b"{}"), 0) is None


def test_only_chooses_by_recorded_topics() -> None:
    only = Options(only=("+/+/goob/#",))
    assert goes(only, f"{GOOB}/outgoing/logs")
    assert not goes(only, f"{FRED}/outgoing/logs")
    with pytest.raises(TransportError):
        rules_of(Options(only=("a/#/b",)))


# -- capabilities: the topics that pages publish to


CAPABILITIES = f"{GOOB}/outgoing/capabilities"
VALUE: dict[str, Any] = {
    "transport": {"kind": "mqtt"},
    "drive": {"available": True, "controls": True, "topic": f"{GOOB}/incoming/drive-values", "arbitrates": True},
    "lights": {"controls": {"solid": True}, "solid_topic": "home/lamp"},
    "video": {"available": True, "controls": True, "topic": f"{GOOB}/outgoing/front-camera",
              "command_topic": f"{GOOB}/incoming/front-camera"},
    "estop": {"available": True, "status_topics": [f"{GOOB}/outgoing/estop/base", f"{FRED}/outgoing/estop/base"]},
    "system": {"reboot": {"controls": True, "flag_topic": f"{GOOB}/incoming/flags/reboot"}},
    "outlets": {"controls": True, "outlets": [{"name": "a", "controls": True, "command_topic": f"{FRED}/incoming/x"}]},
}  # fmt: skip


def offered(options: Options, value: Any = VALUE) -> dict[str, Any]:
    found = sent(options, Line(0, CAPABILITIES, js(t=ms(0), value=value, schema="pebble-capabilities/v1"), 1, True))
    assert found is not None
    plain: dict[str, Any] = json.loads(found.message.payload)
    assert (plain["t"], plain["schema"]) == (ms(0), "pebble-capabilities/v1")
    return plain["value"]  # type: ignore[no-any-return]


def test_capabilities_of_another_base_name_no_topic_of_the_real_robot() -> None:
    value = offered(Options())
    assert "pebble/robots" not in json.dumps(value)
    assert value["video"] == {
        "available": True, "controls": True, "topic": "replay/robots/goob/outgoing/front-camera",
        "command_topic": "replay/robots/goob/incoming/front-camera",
    }  # fmt: skip
    assert value["drive"] == {
        "available": False, "controls": False, "topic": "replay/robots/goob/incoming/drive-values", "arbitrates": True,
    }  # fmt: skip
    assert value["lights"] == {"controls": False}
    assert value["estop"]["status_topics"] == ["replay/robots/goob/outgoing/estop/base"]
    assert value["system"]["reboot"]["controls"] is False
    assert value["outlets"]["outlets"] == [{"name": "a", "controls": False}]
    assert value["transport"] == {"kind": "mqtt"}


# -- rule 4

MILD = {"drive-values", "lights-solid", "lights-flash", "audio-stream", "soundboard-command"}
INCOMING_TOPICS = [channel.suffix for channel in CHANNELS if channel.direction == INCOMING and not channel.is_pattern]


@pytest.mark.parametrize("suffix", INCOMING_TOPICS)
def test_rule_4_incoming_messages_need_an_option_and_others_than_mild_ones_stay_away(suffix: str) -> None:
    assert not goes(Options(), f"{GOOB}/{suffix}")
    assert goes(EVERYTHING, f"{GOOB}/{suffix}") == (suffix.removeprefix("incoming/") in MILD)


@pytest.mark.parametrize("metric", ["drive-values", "flags/mqtt-video", "lights-solid"])
def test_rule_4_a_retained_command_is_stale(metric: str) -> None:
    assert not goes(EVERYTHING, f"{GOOB}/incoming/{metric}", js(x=0), retained=True)


# -- rule 5


@pytest.mark.parametrize("flags", [{"retain": True}, {"retained": True}])
def test_rule_5_nothing_is_retained(flags: dict[str, bool]) -> None:
    found = sent(EVERYTHING, Line(0, f"{GOOB}/outgoing/charging-status", b"{}", 1, **flags))
    assert found is not None
    assert not found.message.retain


@pytest.mark.parametrize("metric", ["online", "heartbeat"])
def test_rule_5_old_heartbeats_are_never_sent(metric: str) -> None:
    assert goes(EVERYTHING, f"{GOOB}/outgoing/{metric}", js(t=ms(0)), retain=True)
    assert not goes(EVERYTHING, f"{GOOB}/outgoing/{metric}", js(t=ms(0)), retained=True)


# -- rule 7


def test_rule_7_zeros_are_known() -> None:
    drive = f"{GOOB}/incoming/drive-values"
    for payload, moves in ((js(x=0.1), True), (js(x=0, z=0), False), (js(value={"z": "0.5"}), True), (b"{}", False)):
        found = sent(EVERYTHING, Line(0, drive, payload))
        assert found is not None
        assert found.moves is moves
    assert json.loads(zero(drive).payload) == {"x": 0, "z": 0, "y": 0, "valid_ms": 0}
    assert zero(drive).qos is QoS.DELIVERED


# -- payloads


def test_payloads_stay_as_they_are_but_for_their_stamps() -> None:
    line = Line(0, f"{GOOB}/outgoing/logs", b'{"message":"pebble/robots/goob/x","t":1700000000000}')
    as_is = sent(Options(), line)
    assert as_is is not None
    assert as_is.message.payload == line.payload
    channel = Channel(1, line.topic, "json", {})
    moved = rules_of(Options(), line).outgoing(Recorded(channel, 0, 0, 0, line.payload), 5 * 10**9)
    assert moved is not None
    assert moved.message.payload == line.payload.replace(b"1700000000000", b"1700000005000")
