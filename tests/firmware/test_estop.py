"""MiniLAMP's and BenJr's emergency stop, in virtual time: messages, states, and the file that survives a power cut."""

from __future__ import annotations

import errno
import json
from itertools import pairwise
from typing import Any

import pytest

from pebble.contract import ESTOP_STATE, codec
from pebble.extensions.lab.simulation.micropython.faults import failure
from tests.firmware.drill import BASE, DRIVE, ESTOP, NAME, RESET, START_S, STATE, Drill
from tests.firmware.test_network_robot import AHEAD, KINDS, online, published

FILE = "/estop.json"
A, B, C = NAME, "00000000000000bb", "00000000000000cc"


def signed(drill: Drill, run: int, z: float = 0.5, **more: Any) -> None:
    drill.command(0.0, z, source="autonomy", run=run, **more)


def states(drill: Drill) -> list[Any]:
    return published(drill, "estop/mcu")


def stopped(kind: str = "benjr", name: str = A) -> Drill:
    drill = online(kind)
    drill.stop(name)
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
    "payload",
    [b"{}", b'{"stop": "<16 hex digits>"}', b"x", b"[" * 400, b'{"stop": "', b"\xff", b"x" * 700, b"x" * 5000],
    ids=["empty object", "no name", "no JSON", "deep", "torn", "no UTF-8", "long", "longer than the memory"],
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


@pytest.mark.parametrize("topic", [ESTOP, RESET])
def test_an_empty_payload_does_nothing(topic: str) -> None:
    drill = online("benjr")
    count = len(states(drill))
    drill.broker.publish(topic, b"", qos=1)
    drill.wait(0.5)
    assert len(states(drill)) == count


def test_retained_copies_do_nothing() -> None:
    drill = Drill("benjr", 1)
    drill.broker.publish(ESTOP, b"x" * 5000, retain=True)
    drill.broker.publish(RESET, b"{}", retain=True)
    while not states(drill):
        drill.turn(0.02)
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


@pytest.mark.parametrize("kind", KINDS)
def test_latched_survives_a_power_cut_and_so_does_free(kind: str) -> None:
    drill = stopped(kind)
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
@pytest.mark.parametrize("torn", [False, True])
def test_a_power_cut_in_the_middle_leaves_the_old_file_or_the_new_one(at: str, torn: bool) -> None:
    drill = stopped()

    def before(what: str, path: str, data: bytes) -> None:
        if what == at:
            if torn and what == "write":
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
