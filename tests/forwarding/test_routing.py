"""Table A.1 as a pure function, row by row, and that of the mirror; commands that tell their own age."""

from __future__ import annotations

import json
from typing import Any, NamedTuple

import pytest

from pebble.config import Config, parse
from pebble.contract import INCOMING, OUTGOING
from pebble.forwarding.command_ages import MOST, CommandAges, ends_something
from pebble.forwarding.routing import MIRROR, TABLE_A1, Drop, Forward, Rules, Side, route
from pebble.forwarding.subjects import Subjects
from pebble.transports import Message, QoS, clock
from pebble.transports.topics import matches
from tests.kit.configs import at
from tests.services.mqtt_bridge.bridge_rig import BASE, make_config

pytestmark = pytest.mark.computing

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
    (REMOTE, (*COMMANDS[1:], *ACTIONS), {}, COMMAND),
    *((REMOTE, COMMANDS[:1], how, DRIVE) for how in ({}, {"qos": 0}, HIDDEN)),
    (REMOTE, STRANGE, {"qos": 0}, forward(0, urgent=True)),
    *((REMOTE, FLAGS, how, FLAG) for how in ({}, REQUESTED, HIDDEN, RETAINED)),
    *((REMOTE, NIGHT, how, FLAG) for how in (REQUESTED, RETAINED)),
    (REMOTE, NIGHT, {}, forward(urgent=True)),
    *((side, ("incoming/audio-stream",), {"qos": 0}, Drop.MEDIA) for side in Side),
    # 3: outgoing/# is never forwarded back into local
    *((REMOTE, (*OUT, "outgoing/online", "outgoing/logs"), how, Drop.ONE_WAY) for how in ({}, RETAINED)),
    # 4: incoming/flags/# is always mirrored to remote
    (LOCAL, FLAGS, {}, FLAG),
    (LOCAL, ACTIONS, {}, COMMAND),
    (LOCAL, NIGHT, REQUESTED, FLAG),
    # What happens once is never forwarded if it is retained, or was published to be retained
    *((side, (*COMMANDS, *ACTIONS), how, Drop.STALE) for side in Side for how in (RETAINED, REQUESTED)),
]
#: On the robot's own broker: everything both ways, fast topics included; media not.
ON_THE_ROBOT: list[Row] = [
    *((side, ("outgoing/status",), REQUESTED, forward(retain=True)) for side in Side),
    *((side, ("outgoing/sensors/imu-fast", "outgoing/strange"), {"qos": 0}, forward(0)) for side in Side),
    *((side, (*COMMANDS, *ACTIONS), {}, COMMAND) for side in Side),
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
    "services.mqtt_bridge.topics.reboot": (COMMAND, LOCAL),
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
    assert all(topic.startswith(f"{BASE}/incoming/flags/") for topic in SUBJECTS.flags)
    assert SUBJECTS.filters(INCOMING, OUTGOING) == [f"{BASE}/incoming/#", f"{BASE}/outgoing/#"]
    subjects = Subjects(config_with("services.mqtt_bridge.topics.reboot", f"{BASE}/incoming/again"))
    assert subjects.filters(INCOMING) == [f"{BASE}/incoming/#"]
    for number in range(10_000):
        assert subjects[f"{BASE}/outgoing/n{number}"] is not None
    assert len(subjects) < 5000


MOVES, ZERO = {"z": 0.5}, {"z": 0}
HOLD = {"id": "3f2a91c0"}


class Robot:
    """Judges what is sent to it; ``now`` is its clock, and that of senders shows 1,000 s less."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, profile: str = "wide") -> None:
        self.now = 5000.0
        monkeypatch.setattr(clock, "since_boot", lambda: self.now)
        self.subjects = Subjects(make_config(link={"profile": profile}))
        self.ages = CommandAges()

    def is_late(
        self, metric: str, payload: dict[str, Any], *, ago_s: float, pings_s: float = 0.0, account: str = ""
    ) -> bool:
        """Whether it is late: sent so long ago, where the pings show ``pings_s``."""
        if payload.get("t") == "now":
            payload = payload | {"t": int(1000 * (self.now - ago_s - 1000))}
        topic = f"{BASE}/incoming/{metric}"
        message = Message(topic, json.dumps(payload).encode(), QoS.LATEST, waiting_since=self.now - pings_s)
        subject = self.subjects[topic]
        assert subject is not None
        forward = route(TABLE_A1, Side.REMOTE, subject, message, mirroring=False)
        assert isinstance(forward, Forward)
        waited_s = self.ages.waited_s(subject, message, account) if forward.stamped else message.waited_s
        return waited_s > subject.waits_s and not ends_something(subject, message)

    def knows(self, payload: dict[str, Any], metric: str = "drive-values", account: str = "") -> None:
        """It receives fast ones for three seconds."""
        for _ in range(4):
            self.is_late(metric, payload, ago_s=0.1, account=account)
            self.now += 1.0


@pytest.fixture
def robot(monkeypatch: pytest.MonkeyPatch) -> Robot:
    return Robot(monkeypatch)


class Aged(NamedTuple):
    payload: dict[str, Any]
    ago_s: float
    pings_s: float
    late: bool


OWN = {"t": "now", "key": "0badf00d"}


@pytest.mark.parametrize(
    "row",
    [
        Aged(MOVES | OWN, 0.5, 3.0, late=False),  # pings wait behind pictures
        Aged(MOVES | OWN, 0.7, 0.0, late=True),  # it waited where no ping passes
        Aged(ZERO | OWN, 9.0, 9.0, late=False),
        Aged(MOVES | {"t": "now"}, 0.5, 3.0, late=True),  # without a key
        Aged(MOVES | {"key": "0badf00d"}, 0.1, 3.0, late=True),  # without a clock
        Aged(MOVES | OWN | {"key": "12345678"}, 0.1, 3.0, late=True),  # of another, who is not known
        Aged(MOVES | OWN | {"key": "k" * 81}, 0.1, 3.0, late=True),
        Aged({"value": MOVES | {"key": "0badf00d", "t": 0}}, 0.1, 0.0, late=True),  # wrapped, and of 1970
    ],
)
def test_a_drive_command_is_as_old_as_its_stamp(robot: Robot, row: Aged) -> None:
    robot.knows(MOVES | OWN)
    assert robot.is_late("drive-values", row.payload, ago_s=row.ago_s, pings_s=row.pings_s) is row.late


def test_a_new_key_needs_the_pings(robot: Robot) -> None:
    late = [robot.is_late("drive-values", MOVES | OWN, ago_s=3.0, pings_s=3.0)]
    robot.now += 30.0  # in a queue that has been there all the time
    late.append(robot.is_late("drive-values", MOVES | OWN, ago_s=3.0, pings_s=3.0))
    robot.now += 1.0  # it has gone
    late += [robot.is_late("drive-values", MOVES | OWN, ago_s=0.1, pings_s=pings_s) for pings_s in (0.0, 3.0)]
    robot.now += 2.1
    late.append(robot.is_late("drive-values", MOVES | OWN, ago_s=0.1, pings_s=3.0))
    assert late == [True, True, False, True, False]


def test_a_clock_that_jumps_needs_the_pings_again(robot: Robot) -> None:
    robot.knows(MOVES | OWN)
    late = [robot.is_late("drive-values", MOVES | OWN, ago_s=ago_s, pings_s=6.0) for ago_s in (6.0, -3.0)]
    robot.now += 3.0  # 9 s ahead, in a queue of six
    late.append(robot.is_late("drive-values", MOVES | OWN, ago_s=-3.0, pings_s=6.0))
    late.append(robot.is_late("drive-values", MOVES | OWN, ago_s=-8.9, pings_s=0.1))
    assert late == [True, True, True, False]


@pytest.mark.parametrize(
    ("newer", "ago_s", "late"), [(MOVES, 0.4, True), (ZERO, 0.4, True), (MOVES, 0.1, False)], ids=str
)
def test_a_command_that_is_sent_again_after_a_newer_one_moves_nothing(
    robot: Robot, newer: dict[str, Any], ago_s: float, late: bool
) -> None:
    """With QoS 2 a client does that after a broken handshake, and no robot is shown the mark of a duplicate."""
    robot.knows(MOVES | OWN)
    assert not robot.is_late("drive-values", newer | OWN, ago_s=0.1)
    assert robot.is_late("drive-values", MOVES | OWN, ago_s=ago_s) == late


def test_only_the_key_of_control_counts_where_there_is_one(robot: Robot) -> None:
    robot.ages.keys = frozenset((b"0badf00d",))
    for key in ("0badf00d", "12345678", "0badf00d 12345678"):
        robot.knows(MOVES | OWN | {"key": key})
    keys = ("0badf00d", "12345678", "12345678 0badf00d", "0badf00d2")
    late = [robot.is_late("drive-values", MOVES | OWN | {"key": key}, ago_s=0.1, pings_s=3.0) for key in keys]
    assert late == [False, True, False, True]


def test_where_names_are_checked_a_key_is_its_accounts(robot: Robot) -> None:
    robot.knows(MOVES | OWN, account="ann")
    late = [
        robot.is_late("drive-values", MOVES | OWN, ago_s=0.1, pings_s=3.0, account=name) for name in ("ann", "otto")
    ]
    assert late == [False, True]


def test_invented_keys_take_no_place_of_a_driver(robot: Robot) -> None:
    robot.knows(MOVES | OWN)
    for number in range(10 * MOST):
        robot.is_late("drive-values", MOVES | {"t": number, "key": f"{number:08x}"}, ago_s=0.0)
        robot.is_late("control", HOLD | {"t": number, "id": f"{number:08x}"}, ago_s=0.0)
    assert not robot.is_late("drive-values", MOVES | OWN, ago_s=0.1, pings_s=3.0)


@pytest.mark.parametrize(("profile", "limit_s"), [("wide", 3.0), ("thin", 10.0), ("auto", 10.0)])
@pytest.mark.parametrize("metric", ["control", "control/take"])
def test_a_request_for_control(monkeypatch: pytest.MonkeyPatch, metric: str, profile: str, limit_s: float) -> None:
    robot = Robot(monkeypatch, profile)
    stamped = HOLD | {"t": "now"}
    robot.knows(stamped, metric)
    late = [robot.is_late(metric, HOLD, ago_s=0.0, pings_s=limit_s + more_s) for more_s in (-0.1, 0.1)]
    late += [robot.is_late(metric, stamped, ago_s=ago_s, pings_s=60.0) for ago_s in (limit_s, limit_s + 0.2)]
    late += [robot.is_late(metric, stamped | {"want": "release"}, ago_s=90.0, pings_s=90.0)]
    assert late == [False, True, False, True, False]
