"""The station of switched sockets and the host's own code, without a wire between them."""

from __future__ import annotations

import pytest

from pebble.services.serial_mcu_bridge.pebble_serial_v1.frame import Frame, Type, encode
from pebble.services.serial_mcu_bridge.pebble_serial_v1.manifest import Direction, parse_describe, parse_hello
from pebble.services.serial_mcu_bridge.pebble_serial_v1.struct_v1 import unpack
from tests.firmware.benches import Bench, of
from tests.services.serial_mcu_bridge import mcu_wire as wire


class Station(Bench):
    """``relays`` has every switch; it is asked for its states by ``asked`` and ``frames``."""

    def __init__(self, count: int = 4) -> None:
        super().__init__("outlets", {"outlets": count}, turn_ms=5)
        self.relays: list[tuple[str, bool]] = []
        self.body.on_relay = lambda _now, outlet, on: self.relays.append((outlet, on))
        self.hello = of(self.frames(), Type.HELLO)[0].payload

    def command(self, interface: int, payload: bytes, sequence: int = 1) -> list[Frame]:
        return self.asked(Type.CMD, payload, interface=interface, sequence=sequence)


def states(frames: list[Frame]) -> dict[int, tuple[bool, ...]]:
    """The state of each outlet: bound, reachable, on."""
    return {frame.interface // 2: tuple(map(bool, frame.payload)) for frame in of(frames, Type.STATE)}


@pytest.fixture
def station() -> Station:
    return Station()


def test_its_manifest_is_that_of_the_original_but_for_the_board(station: Station) -> None:
    frames = station.asked(Type.DESCRIBE_REQ)
    (described,) = of(frames, Type.DESCRIBE)
    manifest = parse_describe(described.payload)
    assert parse_hello(of(frames, Type.HELLO)[0].payload) == manifest.hello
    original = parse_describe(wire.STATION.describe())
    assert manifest.interfaces == original.interfaces
    assert (manifest.uid, manifest.hello.schema_hash) == (original.uid, original.hello.schema_hash)


def test_a_smaller_station_has_another_hello() -> None:
    """By it the host knows that it has to ask for the manifest."""
    stations = [Station(count) for count in (1, 2, 4)]
    assert len({station.hello for station in stations}) == 3
    small = stations[0]
    assert [(one.name, one.direction) for one in small.manifest().interfaces] == [
        ("o1_set", Direction.IN),
        ("o1_state", Direction.OUT),
    ]
    assert of(small.command(3, b"\1"), Type.NACK)[0].payload == b"unknown_interface"


def test_all_states_follow_a_manifest_and_then_only_changes(station: Station) -> None:
    assert states(station.frames(3.0)) == {}
    frames = station.asked(Type.DESCRIBE_REQ)
    assert states(frames) == dict.fromkeys((1, 2, 3, 4), (True, True, False))
    assert [frame.type for frame in frames].index(Type.DESCRIBE) < [frame.type for frame in frames].index(Type.STATE)
    fields = next(one.fields for one in parse_describe(of(frames, Type.DESCRIBE)[0].payload).interfaces if one.id == 2)
    assert unpack(fields, of(frames, Type.STATE)[0].payload) == {"bound": True, "reachable": True, "on": False}


def test_a_command_switches_its_relay_and_no_other(station: Station) -> None:
    frames = station.command(5, b"\1", sequence=77)
    assert [(one.interface, one.sequence) for one in of(frames, Type.ACK)] == [(5, 77)]
    assert states(frames) == {3: (True, True, True)}
    assert states(station.command(5, b"\0")) == {3: (True, True, False)}
    assert station.relays == [("o3", True), ("o3", False)]


def test_what_it_refuses(station: Station) -> None:
    unknown = [(interface, b"\1", b"unknown_interface") for interface in (0, 2, 9, 65535)]
    for interface, payload, why in (*unknown, *((1, bad, b"bad_payload") for bad in (b"", b"\2", b"\1\0"))):
        assert [one.payload for one in of(station.command(interface, payload), Type.NACK)] == [why], interface
    assert station.relays == []


@pytest.mark.parametrize("commands", [(), (b"\0",)], ids=["left on", "switched off"])
def test_a_relay_that_is_not_there_is_unreachable_until_it_is_back_and_does_not_come_on_by_itself(
    station: Station, commands: tuple[bytes, ...]
) -> None:
    station.command(7, b"\1")
    station.body.connect("o4", False)
    assert states(station.frames()) == {4: (True, False, False)}
    assert of(station.command(7, b"\1"), Type.NACK)[0].payload == b"command_failed"
    assert [len(of(station.command(7, one), Type.ACK)) for one in commands] == [1] * len(commands)
    station.body.connect("o4", True)
    assert states(station.frames()) == {4: (True, True, False)}
    assert station.relays == [("o4", True), ("o4", False)]


@pytest.mark.parametrize("how", ["reset", "failure"])
def test_everything_is_off_after_a_reset_and_when_the_firmware_fails(station: Station, how: str) -> None:
    station.command(1, b"\1")
    if how == "reset":
        station.board.load("outlets", {})
    else:
        station.robot.stop()
    station.body.end_turn()
    assert station.relays == [("o1", True), ("o1", False)]


@pytest.mark.parametrize("commands", [100, 101])
def test_states_for_which_there_was_no_room_are_sent_later(station: Station, commands: int) -> None:
    station.board.console.reading = False
    for number in range(commands):
        station.board.type(encode(Frame(Type.CMD, bytes((number & 1,)), interface=1)))
        station.turn(0.05)
    station.board.console.reading = True
    frames = station.frames(1.0)
    assert of(frames, Type.LOG), "nothing was lost"
    assert states(frames)[1] == (True, True, commands % 2 == 0)


def test_a_state_that_waits_for_room_is_not_lost(station: Station) -> None:
    station.board.console.reading = False
    while (
        station.robot.out.used <= len(station.robot.out.ring) - 23
    ):  # so that a pong has room, and then a state has not
        station.board.type(encode(Frame(Type.PING)))
        station.turn(0.01)
    station.body.connect("o4", False)
    station.turn(1.0)
    station.board.console.reading = True
    frames = station.frames(1.0)
    assert of(frames, Type.LOG) == []
    (state,) = of(frames, Type.STATE)
    assert (state.interface, state.sequence) == (8, 5)
