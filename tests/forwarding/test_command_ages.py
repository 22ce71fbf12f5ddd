"""Drive commands and requests for control that tell their own age."""

from __future__ import annotations

import json
from typing import Any, NamedTuple

import pytest

from pebble.forwarding.command_ages import MOST, CommandAges, ends_something
from pebble.forwarding.routing import TABLE_A1, Forward, Side, route
from pebble.forwarding.subjects import Subjects
from pebble.transports import Message, QoS, clock
from tests.services.mqtt_bridge.bridge_rig import BASE, make_config

pytestmark = pytest.mark.computing

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


class Row(NamedTuple):
    payload: dict[str, Any]
    ago_s: float
    pings_s: float
    late: bool


OWN = {"t": "now", "key": "0badf00d"}


@pytest.mark.parametrize(
    "row",
    [
        Row(MOVES | OWN, 0.5, 3.0, late=False),  # pings wait behind pictures
        Row(MOVES | OWN, 0.7, 0.0, late=True),  # it waited where no ping passes
        Row(ZERO | OWN, 9.0, 9.0, late=False),
        Row(MOVES | {"t": "now"}, 0.5, 3.0, late=True),  # without a key
        Row(MOVES | {"key": "0badf00d"}, 0.1, 3.0, late=True),  # without a clock
        Row(MOVES | OWN | {"key": "12345678"}, 0.1, 3.0, late=True),  # of another, who is not known
        Row(MOVES | OWN | {"key": "k" * 81}, 0.1, 3.0, late=True),
        Row({"value": MOVES | {"key": "0badf00d", "t": 0}}, 0.1, 0.0, late=True),  # wrapped, and of 1970
    ],
)
def test_a_drive_command_is_as_old_as_its_stamp(robot: Robot, row: Row) -> None:
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
