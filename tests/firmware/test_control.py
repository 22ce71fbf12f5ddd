"""Emergency stop and control of a board, in virtual time: messages, states, files, and what moves it."""

from __future__ import annotations

import errno
import json
from itertools import pairwise
from random import Random
from typing import Any

import pytest

from common.estop import fields
from common.lease import request_of
from pebble.contract import CONTROL, CONTROL_STATE, ESTOP_STATE, codec
from pebble.errors import PayloadError
from pebble.extensions.lab.simulation.micropython.faults import failure
from tests.firmware.drill import BASE, DRIVE, ESTOP, HOLDER, NAME, RESET, START_S, STATE, Drill
from tests.firmware.drill import CONTROL as REQUESTS
from tests.firmware.test_network_robot import AHEAD, KINDS, online, published

FILE = "/estop.json"
A, B, C = NAME, "00000000000000bb", "00000000000000cc"


def signed(drill: Drill, run: int, z: float = 0.5, **more: Any) -> None:
    drill.command(0.0, z, source="autonomy", run=run, **more)


def states(drill: Drill) -> list[Any]:
    return published(drill, "estop/mcu")


def stopped() -> Drill:
    drill = online("benjr")
    drill.stop()
    drill.wait(0.5)
    assert drill.state()["latched"]
    return drill


def reconnect(drill: Drill) -> None:
    """A power cut, until the robot has published its state again."""
    before = len(states(drill))
    drill.cut_power()
    while len(states(drill)) == before:
        drill.turn(0.02)
        assert drill.seconds < 60


@pytest.mark.parametrize("kind", KINDS)
def test_a_stop_halts_latches_and_is_confirmed(kind: str) -> None:
    drill = online(kind)
    drill.command(0.0, 0.5)
    drill.wait()
    assert drill.outputs() == AHEAD[kind]
    drill.stop(by="ann", why="test")
    drill.wait()
    assert not any(drill.outputs())
    message = [one.message for one in drill.broker.received if one.message.topic == STATE][-1]
    assert message.retain
    state = codec.decode(ESTOP_STATE, message.payload)
    assert (state.latched, state.count, state.recent, state.by, state.why) == (True, 1, [A], "ann", "test")
    assert (state.persisted, len(state.boot)) == (True, 8)
    drill.nonsense(b'{"x": 0, "z": 0.5}')
    drill.wait()
    assert not any(drill.outputs())


@pytest.mark.parametrize(
    "payload", [b"{}", b"[" * 400, b"x" * 700, b"x" * 5000], ids=["no name", "deep", "long", "longer than the memory"]
)
def test_what_cannot_be_read_is_a_stop_without_a_name(payload: bytes) -> None:
    drill = online("benjr")
    drill.broker.publish(ESTOP, payload, qos=1)
    drill.wait(0.6)
    first = drill.state()
    assert (first["latched"], first["count"], len(first["recent"][0])) == (True, 1, 16)
    drill.broker.publish(ESTOP, payload, qos=0)
    drill.wait(0.6)
    assert drill.state()["count"] == 2
    assert drill.state()["recent"][1:] == first["recent"]


def test_retained_copies_and_empty_payloads_do_nothing() -> None:
    drill = Drill("benjr", 1)
    drill.broker.publish(ESTOP, b"x" * 5000, retain=True)
    drill.broker.publish(RESET, b"{}", retain=True)
    while not states(drill):
        drill.turn(0.02)
    for topic in (ESTOP, RESET):
        drill.broker.publish(topic, b"", qos=1)
    drill.wait(1.0)
    assert [(state["latched"], state["count"]) for state in states(drill)] == [(False, 0)]
    assert drill.robot.refused == 2


def test_a_zero_counts_though_a_newer_command_replaces_it() -> None:
    """A person's zero ends the script that moves, in whatever order they are read."""
    drill = online("benjr")
    drill.wait(3.0)
    signed(drill, 17)
    drill.wait()
    assert any(drill.outputs())
    drill.command(0.0, 0.0)
    signed(drill, 17)
    drill.wait()
    assert not any(drill.outputs())
    assert drill.state()["barred"] == 17


def test_latched_survives_a_power_cut_and_so_does_free() -> None:
    drill = stopped()
    boot = drill.state()["boot"]
    reconnect(drill)
    state = drill.state()
    assert (state["latched"], state["count"], state["recent"], state["persisted"]) == (True, 0, [A], True)
    assert state["boot"] != boot
    drill.nonsense(b'{"z": 0.5}')
    drill.wait()
    assert not any(drill.outputs())
    drill.reset()
    drill.wait(0.5)
    reconnect(drill)
    assert (drill.state()["latched"], drill.state()["recent"]) == (False, [A])


def test_the_file_is_written_when_latched_changes_and_not_per_stop_with_motors_off() -> None:
    drill = online("benjr")
    drill.command(0.0, 0.5)
    drill.wait()
    written: list[tuple[str, str, Any]] = []
    drill.board.files.before = lambda what, path, _data: written.append((what, path, drill.outputs()))
    for name in (A, B, A, C, A):
        drill.stop(name)
        drill.wait(0.3)
    assert written == [("write", "/estop.new", (0.0, 0.0)), ("rename", FILE, (0.0, 0.0))]
    drill.reset()
    drill.wait(0.3)
    assert len(written) == 4
    assert json.loads(drill.board.files[FILE])["recent"] == [C, B, A]


@pytest.mark.parametrize(("number", "persisted"), [(errno.ENOSPC, False), (errno.EROFS, None)])
def test_a_file_that_cannot_be_written_is_no_confirmation_and_is_tried_again_at_the_next_repetition(
    number: int, persisted: bool | None
) -> None:
    def fail(*_: object) -> None:
        raise failure(number)

    drill = online("benjr")
    drill.board.files.before = fail
    drill.stop()
    drill.wait(0.5)
    assert (drill.state()["latched"], drill.state()["persisted"]) == (True, persisted)
    drill.board.files.before = lambda *_: None
    drill.stop()
    drill.wait(0.5)
    assert drill.state()["persisted"] is True


class PowerLostError(BaseException):
    """A stand-in for a power cut in the middle of a change."""


@pytest.mark.parametrize("at", ["write", "rename"])
def test_a_power_cut_in_the_middle_leaves_the_old_file_or_the_new_one(at: str) -> None:
    drill = stopped()

    def before(what: str, path: str, data: bytes) -> None:
        if what == at:
            if what == "write":
                drill.board.files[path] = data[: len(data) // 2]
            raise PowerLostError

    drill.board.files.before = before
    drill.reset()
    with pytest.raises(PowerLostError):
        drill.wait(1.0)
    drill.board.files.before = lambda *_: None
    reconnect(drill)
    assert drill.state()["latched"]
    assert drill.state()["recent"] == [A]


def test_at_most_four_states_a_second_and_the_newest_gets_out() -> None:
    drill = online("benjr")
    start = drill.clock.now()
    for number in range(100):
        drill.stop(f"{number:016x}", by="b" * 99, why="w" * 99)
        drill.wait(0.03)
    drill.wait(0.5)
    times = [one.at for one in drill.broker.received if one.message.topic == STATE and one.at > start]
    assert min(later - earlier for earlier, later in pairwise(times)) > 0.2
    assert drill.state()["count"] == 100
    assert drill.state()["recent"] == [f"{number:016x}" for number in (99, 98, 97, 96)]


def test_a_state_has_at_most_300_bytes() -> None:
    drill = online("benjr")
    drill.wait(3.0)
    signed(drill, (1 << 30) - 1)
    drill.robot.stops.latch.count = (1 << 30) - 10
    for name in (A, B, C, "00000000000000dd"):
        drill.stop(name, by="b" * 99, why="w" * 99)
    drill.wait(0.5)
    drill.reset(count=1)
    drill.wait(0.5)
    drill.request(by="z" * 60, device="z" * 60)
    drill.request("bbbbbbbb", by="z" * 60)
    drill.wait(1.0)
    assert len(drill.received(HOLDER)[-1]) <= 300
    assert codec.decode(CONTROL_STATE, drill.received(HOLDER)[-1]).asks == "z" * 40
    payload = drill.received(STATE)[-1]
    state = json.loads(payload)
    assert len(payload) == 300
    assert (state["reset_refused"], state["barred"], state["by"]) == ("count", (1 << 30) - 1, "b" * 32)
    assert set(state["why"]) == {"w"}


@pytest.mark.parametrize("refused", [ESTOP, RESET])
def test_without_both_topics_a_stop_is_only_a_zero(refused: str) -> None:
    drill = online("benjr", refused={refused})
    assert published(drill, "capabilities")[-1]["value"]["estop"]["available"] is False
    drill.command(0.0, 0.5)
    drill.wait()
    drill.stop()
    drill.wait()
    assert any(drill.outputs()) == (refused == ESTOP)  # it is not delivered
    assert states(drill) == []
    assert not drill.robot.stops.latch.latched


def test_the_refusal_of_the_drive_topic_is_fatal() -> None:
    drill = Drill("benjr", 1)
    drill.broker.refused = {DRIVE}
    drill.run(8.0)
    assert drill.robot.session.connection.reason == "subscription refused"
    assert not drill.received(f"{BASE}/outgoing/online", START_S)


@pytest.mark.parametrize(
    ("kind", "security", "others"),
    [("minilamp", {}, False), ("benjr", {"level": "login", "strangers": "drive"}, True)],
)
def test_two_drivers_and_only_who_has_control_moves_by_a_key(kind: str, security: dict[str, str], others: bool) -> None:
    drill = online(kind, security=security)
    assert drill.control() == {
        "by": "", "id": "", "key": "", "device": "", "asks": "", "asks_id": "", "others": False, "named": False,
        "boot": drill.state()["boot"],
    }  # fmt: skip
    drill.request("aaaaaaaa", by="Ann", device="phone")
    drill.wait(0.5)
    ann = drill.control()
    assert (ann["by"], ann["id"], ann["device"], len(ann["key"])) == ("ann", "aaaaaaaa", "phone", 8)
    drill.command(0, 0.5, key=ann["key"])
    drill.wait(0.2)
    assert any(drill.outputs())
    drill.request("bbbbbbbb", by="otto")
    drill.wait(0.5)
    assert (drill.control()["key"], drill.control()["asks"]) == (ann["key"], "otto")
    drill.request("bbbbbbbb", by="otto", take=True)
    drill.wait(0.1)
    assert not any(drill.outputs())  # each new driver begins with wheels at rest
    drill.nonsense(json.dumps({"z": 1, "key": ann["key"]}).encode())
    drill.wait(0.5)
    otto = drill.control()
    assert not any(drill.outputs())
    drill.command(0, 0.5, key=otto["key"])
    drill.wait(0.2)
    assert any(drill.outputs())
    drill.wait(1.0)
    assert moves(drill, "drive-values", z=0.7) is others
    drill.wait(0.5)
    assert drill.control()["others"] is others
    drill.request("bbbbbbbb", want="release")
    drill.wait(0.5)
    assert drill.control()["key"] == ""
    assert moves(drill, "drive-values", z=0.7)


def test_control_ends_without_its_holder_and_outlives_a_connection() -> None:
    drill = online("minilamp")
    drill.request(for_ms=10_000)
    drill.wait(0.5)
    drill.broker.drop_all()
    states = len(drill.received(HOLDER))
    drill.wait(6.0)
    assert len(drill.received(HOLDER)) > states
    assert drill.control()["id"] == "aaaaaaaa"
    drill.wait(6.0)
    assert drill.control()["key"] == ""


def test_without_its_topic_a_board_has_no_control() -> None:
    drill = online("benjr", refused={REQUESTS})
    capabilities = json.loads(drill.received("pebble/robots/rover/outgoing/capabilities")[-1])
    assert capabilities["value"]["drive"]["control"] is False
    assert drill.control() == {}
    drill.command(0, 0.5)
    drill.wait(0.2)
    assert any(drill.outputs())


def at_named() -> Drill:
    """A board that checks names, and page-1/ann has control of it."""
    drill = online("benjr", security={"level": "named", "strangers": "refuse"})
    drill.clock.watch = drill.check = lambda: None  # type: ignore[method-assign]  # the rule of drills knows no names
    send(drill, "by/page-1/control", id="aaaaaaaa", by="Ann", device="phone", for_ms=10_000)
    drill.wait(0.5)
    return drill


def send(drill: Drill, metric: str, *, retain: bool = False, **body: Any) -> None:
    drill.broker.publish(f"{BASE}/incoming/{metric}", json.dumps(body).encode(), qos=1, retain=retain)


def moves(drill: Drill, metric: str, **body: Any) -> bool:
    """Whether this drive command moves a board that stands; the rule of drills knows no strangers."""
    drill.clock.watch = drill.check = lambda: None  # type: ignore[method-assign]
    send(drill, metric, **body)
    drill.wait(0.3)
    moving = any(drill.outputs())
    send(drill, "drive-values", z=0)
    drill.wait(0.2)
    assert not any(drill.outputs())  # a zero needs no name
    return moving


def test_of_what_has_no_name_or_is_retained_only_stops_and_zeros_count() -> None:
    drill = at_named()
    key = drill.control()["key"]
    for metric in ("control", "control/take", "by/otto/by/otto/control"):
        send(drill, metric, id="bbbbbbbb", by="otto")
    send(drill, "by/otto/control/take", id="bbbbbbbb", retain=True)  # live: it counts, and again as a retained one not
    drill.wait(0.5)
    assert (drill.control()["by"], drill.control()["id"]) == ("otto", "bbbbbbbb")
    send(drill, "by/page-1/control/take", id="aaaaaaaa", by="ann")
    drill.wait(0.5)
    drill.broker.drop_all()
    drill.wait(5.0)
    assert drill.control()["by"] in ("page-1/ann", "")
    assert drill.control()["key"] != key
    send(drill, "estop", stop="00000000000000aa", by="anybody")
    drill.wait(0.3)
    assert drill.state()["latched"]
    state = drill.state()
    for metric in ("estop-reset", "by/otto/by/otto/estop-reset"):
        send(drill, metric, boot=state["boot"], count=state["count"])
    drill.wait(0.5)
    assert drill.state()["latched"]
    send(drill, "by/sam/estop-reset", boot=state["boot"], count=state["count"])
    drill.wait(0.5)
    assert not drill.state()["latched"]
    send(drill, "by/otto/estop", stop="00000000000000bb", by="Eve")
    drill.wait(0.3)
    assert (drill.state()["latched"], drill.state()["by"]) == (True, "otto/eve")


def test_a_topic_that_fits_nowhere_ends_the_connection_and_moves_nothing() -> None:
    drill = at_named()
    send(drill, "by/page-1/drive-values", z=0.5, key=drill.control()["key"])
    drill.wait(0.1)
    assert any(drill.outputs())
    send(drill, f"by/{'a' * 5000}/drive-values", z=1)
    drill.wait(0.5)
    assert not any(drill.outputs())
    drill.wait(5.0)
    assert drill.robot.session.connection.state == "online"


def test_a_level_that_is_unknown_is_refused() -> None:
    for security in ({"level": "nmaed"}, {"level": "named", "strangers": "all"}):
        with pytest.raises(ValueError, match="not in"):
            online("benjr", security=security)


def test_a_board_reads_requests_as_linux_does() -> None:
    random, accepted = Random(1), 0
    values = {
        "id": ["3f2a91c0", "3F2A91C0", "3f2a91c", "", 7, None],
        "want": ["hold", "release", "drive", None],
        "by": ["ann", "page-1/Ann B.", "a" * 60, 7, None],
        "device": ["phone", "x" * 60, []],
        "for_ms": [3000, 0, 1500.5, 99_999, "1", True, None],
    }
    for _ in range(3000):
        names = [name for name in values if name == "id" or random.random() < 0.4]
        body = {name: random.choice(values[name]) for name in names}
        body = {"value": body, "by": "x"} if random.random() < 0.2 else body
        try:
            request = codec.decode(CONTROL, json.dumps(body).encode())
            ms = 0 if request.ends() else int(min(max(request.for_ms, 1), 10_000))
            expected = request.id, request.by, request.device, ms
            accepted += 1
        except PayloadError:
            expected = None
        assert request_of(fields(body)) == expected, body
    assert accepted > 100
