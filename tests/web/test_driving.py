"""Gestures and leases in the server: what moves, what stops, and what never moves again."""

from __future__ import annotations

from itertools import count

import pytest
from msgspec import UNSET

from pebble.client.pace_of_link import WIDE, pace_of
from pebble.contract.levels import LEVELS
from pebble.contract.payloads import Drive, LinkLevel, LinkState
from pebble.transports import QoS
from pebble.web.drive.driving import LET_GO, Command, Driving, Tab
from pebble.web.messages import DriveOp

REF, OTHER = "pebble/robots/goob", "pebble/robots/fred"
MOVE = Command(REF, Drive(z=0.5, valid_ms=WIDE.valid_ms))
ZERO = Command(REF, Drive())
FINAL = Command(REF, Drive(valid_ms=0))
STEP_S = 0.05


class World:
    """One server, whose time is ``now``, and pages that it has just received from."""

    def __init__(self) -> None:
        self.driving = Driving()
        self.now = 100.0
        self._names = count(1)

    def tab(self, user: str = "anna") -> Tab:
        tab = Tab(f"token {next(self._names)}", user, "desk")
        self.receive(tab)
        return tab

    def receive(self, tab: Tab) -> None:
        """An echo of the page: its clock shows the same time."""
        tab.clock.echo(tab.clock.ping(self.now), 1000 * self.now, self.now)

    def holder(self, user: str = "anna") -> Tab:
        tab = self.tab(user)
        assert self.take(tab) == ""
        return tab

    def take(self, tab: Tab, *, over: bool = False) -> str:
        return self.driving.take(tab, REF, self.now, over=over).refused

    def drive(self, tab: Tab, g: int, *, z: float = 0.5, ref: str = REF, age: float = 0.0, blocked: str = "") -> object:
        """Commands, or why it was refused."""
        op = DriveOp(ref=ref, g=g, t=1000 * (self.now - age), z=z)
        commands, refused = self.driving.drive(tab, op, self.now, blocked)
        return refused or commands

    def zero(self, tab: Tab, g: int, *, final: bool = False, age: float = 0.0) -> list[Command]:
        op = DriveOp(ref=REF, g=g, t=1000 * (self.now - age), final=final)
        return self.driving.drive(tab, op, self.now).commands

    def wait(self, seconds: float, *tabs: Tab) -> list[Command]:
        """What the server sends by itself meanwhile; these pages answer its pings."""
        commands = []
        for _ in range(round(seconds / STEP_S)):
            self.now += STEP_S
            for tab in tabs:
                self.receive(tab)
            commands += self.driving.tick(self.now)
        return commands


@pytest.fixture
def world() -> World:
    return World()


# -- gestures


def test_a_gesture_moves_and_its_release_stops(world: World) -> None:
    tab = world.holder()
    assert world.drive(tab, 1) == [MOVE]
    world.now += STEP_S
    assert world.zero(tab, 1) == [ZERO]
    assert world.drive(tab, 1) == LET_GO


def test_each_gesture_has_a_greater_number(world: World) -> None:
    tab = world.holder()
    assert world.drive(tab, 5) == [MOVE]
    world.zero(tab, 5)
    assert world.drive(tab, 4) == LET_GO
    assert world.drive(tab, 6) == [MOVE]


def test_a_gesture_whose_end_was_lost_ends_with_the_next_one(world: World) -> None:
    tab = world.holder()
    world.drive(tab, 1)
    world.now += STEP_S
    op = DriveOp(ref=REF, g=2, t=1000 * world.now, z=0.5)
    assert world.driving.drive(tab, op, world.now) == ([FINAL], LET_GO)
    assert world.drive(tab, 2) == LET_GO
    assert world.drive(tab, 3) == [MOVE]


def test_a_silent_gesture_ends_with_a_final_zero_that_is_repeated(world: World) -> None:
    tab = world.holder()
    world.drive(tab, 1)
    assert world.wait(0.25, tab) == []
    assert world.wait(0.05, tab) == [FINAL]
    assert world.wait(1.0, tab) == [FINAL, FINAL]
    assert world.drive(tab, 1) == LET_GO


def test_commands_that_come_after_a_silence_move_nothing(world: World) -> None:
    """Also if nothing has looked meanwhile: this process stood still."""
    tab = world.holder()
    world.drive(tab, 1)
    world.now += 0.3
    world.receive(tab)
    assert world.drive(tab, 1) == LET_GO
    assert world.drive(tab, 1) == LET_GO
    assert world.drive(tab, 2) == [MOVE]


def test_a_gesture_that_goes_on_is_not_silent_though_it_is_thinned_out(world: World) -> None:
    tab = world.holder()
    world.drive(tab, 1)
    for _ in range(60):
        world.now += 0.01
        world.receive(tab)
        assert world.drive(tab, 1) in ([], [MOVE])
    assert world.driving.tick(world.now) == []


@pytest.mark.parametrize(("level", "qos"), [("wide", 1), ("narrow", 0), ("thin", 0)])
def test_a_link_thins_out_what_moves_and_nothing_that_stops(world: World, level: LinkLevel, qos: int) -> None:
    tab, wanted = world.holder(), LEVELS[level]
    link = LinkState(level=level, drive_hz=wanted.drive_hz, rtt_ms=9, queue_ms=0, t=1)
    world.driving.pace_of = lambda _ref: pace_of(link)
    sent: list[Command] = []
    times: list[object] = []
    for _ in range(40):
        commands = world.drive(tab, 1)
        assert isinstance(commands, list)
        sent += commands
        times += [round(1000 * world.now) if wanted.stamped else UNSET for _ in commands]
        world.now += STEP_S
        world.receive(tab)
    assert len(sent) == 2 * wanted.drive_hz
    assert {(one.qos, one.drive.valid_ms) for one in sent} == {(qos, wanted.valid_ms)}
    assert [one.drive.t for one in sent] == times
    keys = {one.drive.key for one in sent}
    assert (len(keys), UNSET in keys) == (1, not wanted.stamped)
    assert world.zero(tab, 1) == [ZERO]
    assert world.driving.stop(REF, world.now) == [FINAL]
    assert ZERO.qos is FINAL.qos is QoS.DELIVERED


@pytest.mark.parametrize("age", [0.61, 2.0])
def test_a_command_that_is_too_old_ends_the_gesture(world: World, age: float) -> None:
    tab = world.holder()
    world.drive(tab, 1)
    world.now += STEP_S
    assert world.drive(tab, 1, age=age) == "Commands are late"
    assert world.drive(tab, 1) == LET_GO


def test_a_zero_is_forwarded_however_old_it_is(world: World) -> None:
    tab = world.holder()
    world.drive(tab, 1)
    world.now += 30
    assert world.zero(tab, 1, age=29) == [ZERO]


def test_a_zero_is_forwarded_without_lease_and_without_gesture(world: World) -> None:
    assert world.zero(world.tab(), 0) == [FINAL]
    assert world.zero(world.tab("eve"), 7, final=True) == [FINAL]


def test_a_zero_of_another_page_ends_no_gesture(world: World) -> None:
    tab = world.holder()
    world.drive(tab, 1)
    assert world.zero(world.tab("eve"), 9) == [FINAL]
    world.now += STEP_S
    assert world.drive(tab, 1) == [MOVE]


def test_without_an_echo_nothing_moves(world: World) -> None:
    tab = Tab("new", "anna", "")
    world.take(tab)
    assert world.drive(tab, 1) == "The connection to the page is stalled"


def test_a_robot_that_may_not_move_does_not(world: World) -> None:
    tab = world.holder()
    world.drive(tab, 1)
    world.now += STEP_S
    op = DriveOp(ref=REF, g=1, t=1000 * world.now, z=0.5)
    assert world.driving.drive(tab, op, world.now, "Stopped") == ([FINAL], "Stopped")
    assert world.drive(tab, 1) == LET_GO


def test_the_server_makes_a_zero_only_after_motion(world: World) -> None:
    tab = world.holder()
    world.drive(tab, 1)
    world.zero(tab, 1)
    assert world.driving.release(tab, REF, world.now) == []
    assert world.wait(1.0, tab) == []


def test_zeros_that_are_repeated_end_when_a_gesture_begins(world: World) -> None:
    tab, other = world.holder(), world.tab("eve")
    world.drive(tab, 1)
    assert world.take(other, over=True) == ""
    assert world.drive(other, 1) == [MOVE]
    assert world.wait(0.2, other) == []


def test_zeros_are_repeated_for_less_than_300_ms(world: World) -> None:
    tab = world.holder()
    world.drive(tab, 1)
    assert world.driving.stop(REF, world.now) == [FINAL]
    assert len(world.wait(0.3, tab)) == 2
    assert world.wait(2.0, tab) == []


def test_zeros_that_a_frozen_server_did_not_repeat_are_not_sent_later(world: World) -> None:
    world.driving.stop(REF, world.now)
    world.now += 3
    assert world.driving.tick(world.now) == []
    assert world.wait(1.0) == []


# -- the stop


def test_a_stop_ends_the_gesture_that_moves_the_robot(world: World) -> None:
    tab = world.holder()
    world.drive(tab, 1)
    assert world.driving.stop(REF, world.now) == [FINAL]
    world.now += STEP_S
    assert world.drive(tab, 1) == LET_GO
    assert world.drive(tab, 2) == [MOVE]


def test_a_stop_is_forwarded_without_a_driver(world: World) -> None:
    assert world.driving.stop(REF, world.now) == [FINAL]


# -- the lease


def test_without_the_lease_nothing_moves(world: World) -> None:
    tab = world.tab()
    assert world.drive(tab, 1) == "Take control to drive"
    world.holder("eve")
    assert world.drive(tab, 2) == "eve is driving"


def test_who_has_just_driven_is_asked_and_who_rests_is_not(world: World) -> None:
    world.holder()
    other = world.tab("eve")
    assert world.take(other) == "anna is driving"
    world.now += 5
    assert world.take(other) == ""


def test_taking_over_stops_the_one_before(world: World) -> None:
    tab, other = world.holder(), world.tab("eve")
    world.drive(tab, 1)
    commands, refused = world.driving.take(other, REF, world.now, over=True)
    assert (commands, refused) == ([FINAL], "")
    world.now += STEP_S
    assert world.drive(tab, 1) == LET_GO
    assert world.drive(tab, 2) == "eve is driving"
    assert world.drive(other, 1) == [MOVE]


def test_what_is_held_when_the_lease_comes_moves_nothing(world: World) -> None:
    tab = world.tab()
    assert world.drive(tab, 1) == "Take control to drive"
    world.take(tab)
    assert world.drive(tab, 1) == LET_GO
    assert world.drive(tab, 2) == [MOVE]


def test_a_lease_ends_after_a_minute_without_a_gesture(world: World) -> None:
    tab = world.holder()
    world.wait(59, tab)
    assert REF in world.driving.leases
    world.wait(2, tab)
    assert world.driving.leases == {}


def test_a_lease_that_is_used_does_not_end(world: World) -> None:
    tab = world.holder()
    for g in range(1, 40):
        world.drive(tab, g)
        world.zero(tab, g)
        world.wait(5, tab)
    assert REF in world.driving.leases


def test_a_lost_connection_stops_the_robot(world: World) -> None:
    tab = world.holder()
    world.drive(tab, 1)
    assert world.driving.closed(tab, world.now) == [FINAL]
    assert world.driving.leases == {}


def test_a_page_that_connects_again_has_its_lease_but_no_gesture(world: World) -> None:
    tab = world.holder()
    world.drive(tab, 1)
    world.driving.closed(tab, world.now)
    world.now += 1
    again = world.tab()
    world.driving.restore(tab.token, again, world.now)
    assert world.driving.leases[REF].tab is again
    assert again.live is None
    assert world.wait(0.05, again) == []
    assert world.drive(again, 1) == [MOVE]


def test_a_token_is_valid_once(world: World) -> None:
    tab = world.holder()
    world.driving.closed(tab, world.now)
    first, second = world.tab(), world.tab()
    world.driving.restore(tab.token, first, world.now)
    world.driving.closed(first, world.now)
    world.driving.restore(tab.token, second, world.now)
    assert world.driving.leases == {}


def test_a_token_is_void_while_its_connection_lives(world: World) -> None:
    """The browser's "duplicate tab" copies it."""
    tab = world.holder()
    copy = world.tab()
    world.driving.restore(tab.token, copy, world.now)
    assert world.driving.leases[REF].tab is tab
    world.drive(tab, 1)
    assert world.drive(copy, 1) == "anna is driving"


def test_a_lease_waits_five_seconds(world: World) -> None:
    tab = world.holder()
    world.driving.closed(tab, world.now)
    world.now += 5.1
    world.driving.restore(tab.token, world.tab(), world.now)
    assert world.driving.leases == {}


def test_a_lease_that_was_taken_meanwhile_is_not_restored(world: World) -> None:
    tab = world.holder()
    world.driving.closed(tab, world.now)
    other = world.holder("eve")
    world.driving.restore(tab.token, world.tab(), world.now)
    assert world.driving.leases[REF].tab is other


def test_a_revoked_user_has_no_lease_to_come_back_to(world: World) -> None:
    tab = world.holder()
    world.drive(tab, 1)
    assert world.driving.withdraw(tab, world.now) == [FINAL]
    world.driving.restore(tab.token, world.tab(), world.now)
    assert world.driving.leases == {}


def test_who_takes_another_robot_moves_the_first_one_no_more(world: World) -> None:
    tab = world.holder()
    assert world.drive(tab, 1) == [MOVE]
    assert world.driving.moved_by(REF) == "anna"
    assert world.driving.take(tab, OTHER, world.now) == ([FINAL], "")
    assert world.driving.moved_by(REF) == ""
    assert world.drive(tab, 1, ref=OTHER) == LET_GO


def test_each_robot_has_a_lease_of_its_own(world: World) -> None:
    tab, other = world.holder(), world.tab("eve")
    assert world.driving.take(other, OTHER, world.now) == ([], "")
    assert world.drive(tab, 1) == [MOVE]
    assert world.drive(other, 1, ref=OTHER) == [Command(OTHER, MOVE.drive)]
    assert world.drive(other, 1, ref=REF) == "anna is driving"
