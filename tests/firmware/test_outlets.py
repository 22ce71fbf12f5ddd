"""The station of switched sockets and the host's own code, without a wire between them."""

from __future__ import annotations

from typing import Any

import pytest

from pebble.services.serial_mcu_bridge.pebble_serial_v1.frame import Frame, Type, decode, encode
from pebble.services.serial_mcu_bridge.pebble_serial_v1.manifest import Direction, parse_describe, parse_hello
from pebble.services.serial_mcu_bridge.pebble_serial_v1.struct_v1 import unpack
from pebble.simulation.bodies import body_of
from pebble.simulation.micropython.board import Board
from pebble.simulation.micropython.clock import VirtualClock
from tests.services.serial_mcu_bridge import mcu_wire as wire

ASK = encode(Frame(Type.DESCRIBE_REQ))


class Bench:
    """A station whose loop turns every 5 ms, and a host that collects its output."""

    def __init__(self, count: int = 4) -> None:
        self.clock = VirtualClock()
        self.board = Board(self.clock)
        self.body: Any = body_of("outlets", self.board)
        self.relays: list[tuple[str, bool]] = []
        self.body.on_relay = lambda _now, outlet, on: self.relays.append((outlet, on))
        self._rest = b""
        self.robot: Any = self.board.load("outlets", {"outlets": count})

    def turn(self, seconds: float) -> None:
        until = self.clock.now() + seconds
        while self.clock.now() < until:
            self.clock.advance(0.005)
            self.robot.step()
            self.body.end_turn()

    def run(self, seconds: float = 0.2) -> list[Frame]:
        self.turn(seconds)
        *whole, self._rest = (self._rest + self.board.take_output()).split(b"\0")
        return [decode(one) for one in whole if one]

    def command(self, interface: int, payload: bytes, sequence: int = 1) -> list[Frame]:
        self.board.type(encode(Frame(Type.CMD, payload, interface=interface, sequence=sequence)))
        return self.run()


def of(frames: list[Frame], kind: Type) -> list[Frame]:
    return [frame for frame in frames if frame.type is kind]


def states(frames: list[Frame]) -> dict[int, tuple[bool, ...]]:
    """The state of each outlet: bound, reachable, on."""
    return {frame.interface // 2: tuple(map(bool, frame.payload)) for frame in of(frames, Type.STATE)}


@pytest.fixture
def bench() -> Bench:
    made = Bench()
    made.run()
    return made


def test_its_manifest_is_that_of_the_original_but_for_the_board(bench: Bench) -> None:
    bench.board.type(ASK)
    frames = bench.run()
    (described,) = of(frames, Type.DESCRIBE)
    manifest = parse_describe(described.payload)
    assert parse_hello(of(frames, Type.HELLO)[0].payload) == manifest.hello
    original = parse_describe(wire.STATION.describe())
    assert manifest.interfaces == original.interfaces
    assert (manifest.uid, manifest.hello.schema_hash) == (original.uid, original.hello.schema_hash)


def test_a_smaller_station_has_another_hello() -> None:
    """By it the host knows that it has to ask for the manifest."""
    hellos = [of(Bench(count).run(), Type.HELLO)[0].payload for count in (1, 2, 4)]
    assert len(set(hellos)) == 3
    small = Bench(1)
    small.board.type(ASK)
    manifest = parse_describe(of(small.run(), Type.DESCRIBE)[0].payload)
    assert [(one.name, one.direction) for one in manifest.interfaces] == [
        ("o1_set", Direction.IN),
        ("o1_state", Direction.OUT),
    ]
    assert of(small.command(3, b"\1"), Type.NACK)[0].payload == b"unknown_interface"


def test_all_states_follow_a_manifest_and_then_only_changes(bench: Bench) -> None:
    assert states(bench.run(3.0)) == {}
    bench.board.type(ASK)
    frames = bench.run()
    assert states(frames) == dict.fromkeys((1, 2, 3, 4), (True, True, False))
    assert [frame.type for frame in frames].index(Type.DESCRIBE) < [frame.type for frame in frames].index(Type.STATE)
    fields = next(one.fields for one in parse_describe(of(frames, Type.DESCRIBE)[0].payload).interfaces if one.id == 2)
    assert unpack(fields, of(frames, Type.STATE)[0].payload) == {"bound": True, "reachable": True, "on": False}


def test_a_command_switches_its_relay_and_no_other(bench: Bench) -> None:
    frames = bench.command(5, b"\1", sequence=77)
    assert [(one.interface, one.sequence) for one in of(frames, Type.ACK)] == [(5, 77)]
    assert states(frames) == {3: (True, True, True)}
    assert states(bench.command(5, b"\0")) == {3: (True, True, False)}
    assert bench.relays == [("o3", True), ("o3", False)]


@pytest.mark.parametrize(
    ("interface", "payload", "why"),
    [
        (0, b"\1", b"unknown_interface"),
        (2, b"\1", b"unknown_interface"),
        (9, b"\1", b"unknown_interface"),
        (65535, b"\1", b"unknown_interface"),
        (1, b"", b"bad_payload"),
        (1, b"\2", b"bad_payload"),
        (1, b"\1\0", b"bad_payload"),
    ],
)
def test_what_it_refuses(bench: Bench, interface: int, payload: bytes, why: bytes) -> None:
    assert [one.payload for one in of(bench.command(interface, payload), Type.NACK)] == [why]
    assert bench.relays == []


def test_a_relay_that_is_not_there_is_unreachable_until_it_is_back(bench: Bench) -> None:
    bench.command(7, b"\1")
    bench.body.connect("o4", False)
    assert states(bench.run()) == {4: (True, False, False)}
    assert of(bench.command(7, b"\1"), Type.NACK)[0].payload == b"command_failed"
    assert len(of(bench.command(7, b"\0"), Type.ACK)) == 1
    bench.body.connect("o4", True)
    assert states(bench.run()) == {4: (True, True, False)}


def test_an_outlet_does_not_come_on_by_itself(bench: Bench) -> None:
    bench.command(7, b"\1")
    for there in (False, True):
        bench.body.connect("o4", there)
        frames = bench.run()
    assert states(frames) == {4: (True, True, False)}
    assert bench.relays == [("o4", True), ("o4", False)]


def test_everything_is_off_after_a_reset(bench: Bench) -> None:
    bench.command(1, b"\1")
    bench.board.load("outlets", {})
    bench.body.end_turn()
    assert bench.relays == [("o1", True), ("o1", False)]


def test_it_is_off_when_its_firmware_fails(bench: Bench) -> None:
    bench.command(1, b"\1")
    bench.robot.stop()
    bench.body.end_turn()
    assert bench.relays[-1] == ("o1", False)


@pytest.mark.parametrize("commands", [100, 101])
def test_states_for_which_there_was_no_room_are_sent_later(bench: Bench, commands: int) -> None:
    bench.board.console.reading = False
    for number in range(commands):
        bench.board.type(encode(Frame(Type.CMD, bytes((number & 1,)), interface=1)))
        bench.turn(0.05)
    bench.board.console.reading = True
    frames = bench.run(1.0)
    assert of(frames, Type.LOG), "nothing was lost"
    assert states(frames)[1] == (True, True, commands % 2 == 0)


def test_a_state_that_waits_for_room_is_not_lost(bench: Bench) -> None:
    bench.board.console.reading = False
    while bench.robot.out.used <= len(bench.robot.out.ring) - 23:  # so that a pong has room, and then a state has not
        bench.board.type(encode(Frame(Type.PING)))
        bench.turn(0.01)
    bench.body.connect("o4", False)
    bench.turn(1.0)
    bench.board.console.reading = True
    frames = bench.run(1.0)
    assert of(frames, Type.LOG) == []
    (state,) = of(frames, Type.STATE)
    assert (state.interface, state.sequence) == (8, 5)
