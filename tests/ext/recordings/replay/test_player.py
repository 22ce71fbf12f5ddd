"""What of a recording may go out, by the safety rules, and the player in virtual time: order, pace, pause and seek."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from pebble.contract import CHANNELS, INCOMING
from pebble.errors import ConfigError, TransportError
from pebble.extensions.media.packets import KEY_FRAME, Picture, PictureKind
from pebble.extensions.recordings.files.recorded import Channel, Recorded
from pebble.extensions.recordings.replay.player import BusOutput, Player
from pebble.extensions.recordings.replay.rules import Options, Outgoing, ReplayError, Rules, zero
from pebble.extensions.recordings.replay.source import ReplaySource
from pebble.extensions.recordings.stamps import stamp_ns
from pebble.transports import Message, QoS
from tests.ext.recordings.playing import FRED, GOOB, THEN_NS, Line, js, ms, write

ALL = Options(incoming=True)
NOW_NS = 1_800_000_000 * 10**9  # when recordings are replayed


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
    assert [topic for topic, payload in STAYS[what] if goes(ALL, topic, payload)] == []


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


def test_capabilities_of_another_base_name_no_topic_of_the_real_robot() -> None:
    found = sent(Options(), Line(0, CAPABILITIES, js(t=ms(0), value=VALUE, schema="pebble-capabilities/v1"), 1, True))
    assert found is not None
    plain = json.loads(found.message.payload)
    assert (plain["t"], plain["schema"]) == (ms(0), "pebble-capabilities/v1")
    value = plain["value"]
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
    assert goes(ALL, f"{GOOB}/{suffix}") == (suffix.removeprefix("incoming/") in MILD)


@pytest.mark.parametrize(
    ("suffix", "goes_live", "goes_old"),
    [
        ("incoming/drive-values", True, False),  # an old command is stale
        ("incoming/flags/mqtt-video", False, False),
        ("incoming/lights-solid", True, False),
        ("outgoing/online", True, False),  # an old heartbeat is no sign of life
        ("outgoing/heartbeat", True, False),
        ("outgoing/charging-status", True, True),
    ],
)
def test_rules_4_and_5_nothing_is_retained_and_what_was_old_may_stay_away(
    suffix: str, goes_live: bool, goes_old: bool
) -> None:
    for flags, goes_out in (({"retain": True}, goes_live), ({"retained": True}, goes_old)):
        found = sent(ALL, Line(0, f"{GOOB}/{suffix}", js(x=0, t=ms(0)), 1, **flags))
        assert (found is not None) is goes_out
        assert found is None or not found.message.retain


# -- rule 7


def test_rule_7_zeros_are_known() -> None:
    drive = f"{GOOB}/incoming/drive-values"
    for payload, moves in ((js(x=0.1), True), (js(x=0, z=0), False), (js(value={"z": "0.5"}), True), (b"{}", False)):
        found = sent(ALL, Line(0, drive, payload))
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


# -- the player


class Sent(NamedTuple):
    at: float
    message: Message


class Stage:
    """A player in virtual time, and all that it publishes."""

    def __init__(self, path: Path | Sequence[Path], options: Options | None = None, **playing: Any) -> None:
        self.seconds = 0.0  # which only waiting moves on
        self.sent: list[Sent] = []
        self.refuses = 0  # so many of the next messages
        self.takes_s = 0.0  # for each message
        self.waits = 0
        self.actions: list[tuple[float, Any]] = []  # what to do at a time, in order
        source = ReplaySource([path] if isinstance(path, Path) else path)
        self.rules = Rules(options or Options(), source.channels)
        output = BusOutput(self.rules, self._publish, lambda: NOW_NS + round(self.seconds * 1e9))
        clocks = {"now": lambda: self.seconds, "wait": self._wait}
        self.player = Player(source, self.rules.publishes, output, **clocks, **playing)

    def run(self) -> Stage:
        self.player.run()
        return self

    def at(self, seconds: float, action: Any) -> Stage:
        self.actions.append((seconds, action))
        return self

    def payloads(self, topic: str) -> list[bytes]:
        return [sent.message.payload for sent in self.sent if sent.message.topic == topic]

    def _publish(self, message: Message) -> bool:
        if self.refuses:
            self.refuses -= 1
            return False
        self.seconds += self.takes_s
        self.sent.append(Sent(self.seconds, message))
        return True

    def _wait(self, seconds: float) -> None:
        self.waits += 1
        self.seconds += seconds
        while self.actions and self.seconds >= self.actions[0][0]:
            self.actions.pop(0)[1]()


LOGS = f"{GOOB}/outgoing/logs"
DRIVE = f"{GOOB}/incoming/drive-values"
REPLAYED_LOGS, REPLAYED_DRIVE = (topic.replace("pebble/", "replay/", 1) for topic in (LOGS, DRIVE))
ZERO = zero(REPLAYED_DRIVE).payload


def numbers(stage: Stage) -> list[int]:
    """Those of the lines of the log that were sent."""
    return [json.loads(payload)["n"] for payload in stage.payloads(REPLAYED_LOGS)]


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    """A line of the log each second for 60 s."""
    return write(tmp_path / "walk.mcap", [Line(n, LOGS, js(n=n, t=ms(n))) for n in range(60)])


@pytest.mark.parametrize("speed", [0.1, 7.0])
def test_messages_come_in_order_and_at_their_pace(walk: Path, speed: float) -> None:
    stage = Stage(walk, ALL, speed=speed).run()
    assert numbers(stage) == list(range(60))
    assert [round(sent.at * speed, 3) for sent in stage.sent] == list(range(60))
    assert (stage.player.sent, stage.player.skipped, stage.player.ended) == (60, 0, True)


def test_speed_may_change_meanwhile(walk: Path) -> None:
    stage = Stage(walk, ALL)
    stage.at(10.5, lambda: setattr(stage.player, "speed", 10.0)).run()
    assert stage.sent[10].at == pytest.approx(10)
    assert stage.sent[11].at == pytest.approx(10.55, abs=0.01)
    assert stage.sent[-1].at == pytest.approx(10.5 + 4.85, abs=0.01)
    for asked, speed in ((1000, 100), (0.01, 0.1)):
        stage.player.speed = asked
        assert stage.player.speed == speed


@pytest.mark.parametrize(("paused", "number", "begins"), [(False, 11, 100.5), (True, 0, 100)])
def test_a_pause_takes_no_time_of_the_recording(walk: Path, paused: bool, number: int, begins: float) -> None:
    stage = Stage(walk, ALL, paused=paused)
    stage.at(10.5, stage.player.pause).at(100, stage.player.resume).run()
    assert stage.sent[number].at == pytest.approx(begins, abs=0.06)
    assert len(stage.sent) == 60


@pytest.mark.parametrize(("to", "begins"), [(40.2, 41), (-20, 0), (1000, 60)])
def test_seek_goes_on_from_there(walk: Path, to: float, begins: int) -> None:
    stage = Stage(walk, ALL)
    stage.at(10.5, lambda: stage.player.seek(THEN_NS + int(to * 1e9))).run()
    assert numbers(stage) == [*range(11), *range(begins, 60)]


def test_a_loop_begins_again(walk: Path) -> None:
    stage = Stage(walk, ALL, loop=True)
    stage.at(150.5, stage.player.stop).run()
    assert len(stage.sent) == pytest.approx(150, abs=3)
    assert numbers(stage)[60] == numbers(stage)[0] == 0


@pytest.mark.parametrize(("messages", "least", "most"), [(1, 11, 210), (0, 0, 0)])
def test_a_loop_of_one_message_is_no_flood_and_one_of_none_ends(
    tmp_path: Path, messages: int, least: int, most: int
) -> None:
    stage = Stage(write(tmp_path / "one.mcap", [Line(0, LOGS, b"{}")] * messages), ALL, loop=True)
    stage.at(10, stage.player.stop).run()
    assert least <= len(stage.sent) <= most


def test_what_is_refused_is_sent_again_and_nothing_is_lost(walk: Path) -> None:
    stage = Stage(walk, ALL)
    stage.at(9.9, lambda: setattr(stage, "refuses", 20)).run()
    assert len(stage.sent) == 60
    assert stage.sent[10].at == pytest.approx(10.2, abs=0.06)
    assert stage.sent[11].at == pytest.approx(11, abs=0.06)


def test_a_process_that_stood_still_sends_no_burst(walk: Path) -> None:
    stage = Stage(walk, ALL)
    stage.at(10.5, lambda: setattr(stage, "seconds", 3610.5)).run()
    assert stage.sent[12].at - stage.sent[11].at == pytest.approx(1, abs=0.06)


def test_the_caller_acts_also_when_all_is_late(walk: Path) -> None:
    stage = Stage(write(walk, [Line(n / 1e6, LOGS, b"{}") for n in range(5000)]), ALL)
    stage.takes_s = 0.001
    stage.run()
    assert stage.waits > 50


def driving(*seconds: float, stops: float | None = None) -> list[Line]:
    lines = [Line(at, DRIVE, js(x=0, z=0.5), 1) for at in seconds]
    return lines + ([Line(stops, DRIVE, js(x=0, z=0), 1)] if stops is not None else []) + [Line(50, LOGS, b"{}")]


@pytest.mark.parametrize(("stops", "last"), [(None, ZERO), (3, js(x=0, z=0))], ids=["moving", "at rest"])
def test_rule_7_a_recording_that_ends_moving_is_followed_by_a_stop(
    tmp_path: Path, stops: float | None, last: bytes
) -> None:
    stage = Stage(write(tmp_path / "x.mcap", driving(1, 2, stops=stops)[:-1]), ALL).run()
    assert stage.payloads(REPLAYED_DRIVE) == [js(x=0, z=0.5), js(x=0, z=0.5), last]


@pytest.mark.parametrize("what", ["pause", "seek", "stop"])
def test_rule_7_at_each_interruption(tmp_path: Path, what: str) -> None:
    stage = Stage(write(tmp_path / "x.mcap", driving(0, 1, 2)), ALL)
    actions = {"pause": stage.player.pause, "seek": lambda: stage.player.seek(THEN_NS + 40 * 10**9)}
    actions["stop"] = stage.player.stop
    stage.at(2.5, actions[what]).at(10, stage.player.stop).run()
    at = next(sent.at for sent in stage.sent if sent.message.payload == ZERO)
    assert at == pytest.approx(2.5, abs=0.06)
    assert stage.payloads(REPLAYED_DRIVE).count(ZERO) == 1


def test_rule_7_at_each_turn_of_a_loop(tmp_path: Path) -> None:
    stage = Stage(write(tmp_path / "x.mcap", driving(0, 1)[:-1]), ALL, loop=True)
    stage.at(3.5, stage.player.stop).run()
    assert stage.payloads(REPLAYED_DRIVE)[2] == ZERO
    assert stage.payloads(REPLAYED_DRIVE)[-1] == ZERO


def test_rule_7_after_an_error_and_though_it_is_refused_at_first(tmp_path: Path) -> None:
    stage = Stage(write(tmp_path / "x.mcap", driving(0, 1, 2)), ALL)

    def fail() -> None:
        stage.refuses = 10
        raise RuntimeError

    with pytest.raises(RuntimeError):
        stage.at(1.5, fail).run()
    assert stage.payloads(REPLAYED_DRIVE)[-1] == ZERO


STATE = f"{GOOB}/outgoing/charging-status"
CAMERA = f"{GOOB}/outgoing/front-camera"


def test_a_seek_begins_with_the_newest_state(tmp_path: Path) -> None:
    lines = [
        Line(0, f"{GOOB}/outgoing/soundboard-files", js(files=[]), 1, retain=True),
        Line(0.1, f"{GOOB}/outgoing/custom", b"1", 1, retained=True),
        Line(0.2, f"{GOOB}/outgoing/gone", b"1", 1, retain=True),
        Line(0.3, f"{GOOB}/outgoing/gone", b"", 1, retain=True),
        *(Line(n, STATE, js(value=n), 1, retain=True) for n in range(1, 60)),
        *(Line(n + 0.5, LOGS, js(n=n)) for n in range(59)),
        *(Line(n + 0.6, f"{GOOB}/outgoing/online", js(t=ms(n)), 1, retain=True) for n in range(30)),
        *(Line(n + 0.7, f"{GOOB}/incoming/flags/mqtt-video", b"true", 1, retain=True) for n in range(30)),
    ]
    path = write(tmp_path / "x.mcap", sorted(lines, key=lambda line: line.at))
    stage = Stage(path, ALL, since_ns=THEN_NS + int(40.2 * 1e9)).run()
    assert [(sent.message.topic.rpartition("/")[2], sent.message.payload) for sent in stage.sent[:4]] == [
        ("soundboard-files", js(files=[])),
        ("custom", b"1"),
        ("charging-status", js(value=40)),
        ("logs", js(n=40)),
    ]
    assert stage.sent[3].at == 0


def test_state_before_has_stamps_of_its_age(tmp_path: Path) -> None:
    lines = [Line(n, f"{GOOB}/outgoing/status", js(t=ms(n), value={}), 1, retain=True) for n in (5, 60)]
    stage = Stage(write(tmp_path / "x.mcap", lines), since_ns=THEN_NS + 30 * 10**9).run()
    assert stamp_ns(stage.sent[0].message.payload) == NOW_NS - 55 * 10**9  # the recording goes on at 60 s
    assert stamp_ns(stage.sent[1].message.payload) == NOW_NS


@pytest.mark.parametrize("kinds", [(PictureKind.JPEG, PictureKind.DELTA_JPEG), (PictureKind.H264, PictureKind.H264)])
def test_a_seek_begins_at_a_key_frame(tmp_path: Path, kinds: tuple[PictureKind, PictureKind]) -> None:
    whole, delta = kinds
    kinds_of = [(whole, KEY_FRAME), *[(delta, 0)] * 39] * 15
    lines = [
        Line(n / 10, CAMERA, Picture(kind, n, ms(n / 10), b"picture", flags).pack())
        for n, (kind, flags) in enumerate(kinds_of)
    ]
    stage = Stage(write(tmp_path / "x.mcap", lines), ALL)
    stage.at(2.05, lambda: stage.player.seek(THEN_NS + int(33.05 * 1e9))).run()
    frames = [Picture.unpack(sent.message.payload).frame for sent in stage.sent]
    assert frames == [*range(21), *range(320, 331), *range(331, 600)]
    assert stage.sent[31].at == pytest.approx(2.05, abs=0.06)  # the last of those before
    assert stage.sent[32].at == pytest.approx(2.10, abs=0.06)


def test_a_key_frame_of_long_ago_is_of_no_use(tmp_path: Path) -> None:
    lines = [Line(at, CAMERA, Picture(PictureKind.JPEG, at, ms(at), b"picture").pack()) for at in (0, 100)]
    stage = Stage(write(tmp_path / "x.mcap", lines), ALL, since_ns=THEN_NS + 90 * 10**9).run()
    assert len(stage.sent) == 1


def test_a_state_does_not_unpack_media(tmp_path: Path) -> None:
    state = write(tmp_path / "state.mcap", [Line(0, STATE, js(value=True), 1, retain=True)])
    media = write(tmp_path / "media.mcap", [Line(n, f"{GOOB}/outgoing/audio", b"PBAT") for n in range(3)])
    source = ReplaySource([state, media])
    media.write_bytes(b"unreadable")
    assert [message.channel.topic for message in source.state_before(THEN_NS + 10**10)] == [STATE]
