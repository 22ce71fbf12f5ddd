"""Several motor owners that are one robot: what each takes from the others. Who drives: tests/robot."""

from __future__ import annotations

from typing import Any

import pytest
from msgspec import structs

from pebble.config import Security
from pebble.contract.payloads import ControlRequest, ControlState, ControlTurn, Drive
from pebble.motors.control import Control

OWNERS = ("serial", "arm", "tail")  # the first by name is the second here
START_S = 100.0


class Owner:
    """The control of one owner on a clock that the test moves; ``sent`` are its turns."""

    def __init__(self, name: str, owners: tuple[str, ...] = OWNERS, **security: Any) -> None:
        self.name, self.now = name, START_S
        self.sent: list[tuple[float, ControlTurn | None]] = []
        self.states: list[ControlState] = []
        self.control = Control(Security(**security), self.states.append, self.now, name, owners, self._send)

    def _send(self) -> None:
        self.sent.append((round(self.now, 3), self.control.turn(7, self.now)))

    def tick(self, now: float) -> bool:
        """Whether the motors are to be halted."""
        self.now = now
        self.control.tick(now)
        halts = self.control.note(now)
        self.control.show_turn(now)
        return halts

    def request(self, by: str = "ann", *, over: bool = False, want: Any = "hold") -> None:
        request = ControlRequest(id=(by.encode().hex() * 8)[:8], by=by, device="phone", want=want)
        self.control.request(request, over, self.now)
        self.tick(self.now)

    def moves(self, key: str = "", by: str = "") -> bool:
        """Whether a command that moves something is permitted."""
        return not self.control.lease.refuses(True, False, key, by, int(1000 * self.now))

    def receive(self, owner: str, turn: ControlTurn | None) -> bool:
        assert turn is not None
        self.control.receive_turn(owner, turn, self.now)
        return self.tick(self.now)

    @property
    def turn(self) -> ControlTurn:
        turn = self.sent[-1][1]
        assert turn is not None
        return turn


def granted(**fields: Any) -> ControlTurn:
    """What the first sends while Ann has control."""
    fields = {"boot": "b", "turn": 1, "t": 100_000, "key": "k", "id": "aaaaaaaa", "by": "ann", "device": "d"} | fields
    return ControlTurn(**fields)


# -- the first


def test_the_first_moves_nothing_until_all_others_follow_its_newest_turn() -> None:
    first = Owner("arm", strangers="drive")
    assert first.control.peers == {"serial", "tail"}
    first.tick(START_S)
    start = first.turn
    assert (start.turn, start.t, start.key, start.barred) == (0, 100_000, "", 7)
    for owner, shown, moves in (
        ("serial", start, False),
        ("serial", start, False),
        ("tail", structs.replace(start, boot="other"), False),
        ("tail", structs.replace(start, turn=1), False),
        ("tail", start, True),
    ):
        assert not first.receive(owner, shown)
        assert first.moves() is moves
    first.request()
    assert (first.turn.turn, first.turn.id, first.turn.by, first.turn.device) == (1, "616e6e61", "ann", "phone")
    assert not first.moves(first.turn.key)
    for owner in ("serial", "tail"):
        assert not first.moves(first.turn.key)
        first.receive(owner, start)
        assert not first.moves(first.turn.key)
        first.receive(owner, first.turn)
    assert first.moves(first.turn.key)
    first.request(want="release")
    assert (first.turn.turn, first.turn.key, first.turn.id) == (2, "", "")
    assert not first.moves()


def test_a_flood_of_handovers_sends_20_turns_a_second_and_the_newest_one() -> None:
    first = Owner("arm")
    for number in range(300):
        first.request("ann" if number % 2 else "eve", over=True)
    assert len(first.sent) == 20
    due = first.control.due
    assert due is not None
    first.tick(due)
    assert len(first.sent) == 20
    first.tick(101.0)
    assert [(at, turn.turn) for at, turn in first.sent[20:] if turn is not None] == [(101.0, 300), (101.0, 300)]


# -- another one


def test_another_owner_follows_the_first_for_1_5_seconds_of_its_stamp() -> None:
    second = Owner("serial", strangers="drive")
    assert second.control.peers == {"arm"}
    assert not second.moves()
    assert second.control.left_ms(START_S) == 0
    second.now = 101.0
    assert second.receive("arm", granted())  # halts
    assert second.control.left_ms(101.0) == 500
    for at, moves in ((101.0, True), (101.499, True), (101.5, False)):
        second.tick(at)
        assert second.moves("k") is moves
        assert not second.moves("j")
        assert second.moves() is moves
    assert not second.receive("arm", granted(t=101_400))
    assert second.moves("k")


@pytest.mark.parametrize(("turn", "halts", "key"), [
    (granted(t=100_500), False, "k"),
    (granted(t=100_000, turn=2, key="l"), True, "l"),
    (granted(t=100_500, turn=2, key="l"), True, "l"),
    (granted(t=100_500, turn=0, key="l", boot="c"), True, "l"),
    (granted(t=100_500, boot="c", key="l"), True, "l"),
    (granted(t=100_500, turn=2, key=""), True, ""),
    (granted(t=99_999, turn=2, key="l"), False, "k"),
    (granted(t=100_700, turn=2, key="l"), True, "l"),
    (granted(t=100_701, turn=2, key="l"), False, "k"),
])  # fmt: skip
def test_a_turn_that_is_older_or_to_come_is_not_followed(turn: ControlTurn, halts: bool, key: str) -> None:
    second = Owner("serial", strangers="free")
    second.receive("arm", granted())
    second.now = 100.7
    assert second.receive("arm", turn) is halts
    assert second.control.state().key == key
    assert {one: second.moves(one) for one in ("k", "l", "")} == {one: one == key for one in ("k", "l", "")}


def test_another_owner_answers_nobody_and_ends_nothing() -> None:
    second = Owner("serial")
    second.receive("arm", granted(asks="eve", asks_id="bbbbbbbb", others=True))
    shown = second.control.state()
    assert (shown.by, shown.id, shown.device, shown.key) == ("ann", "aaaaaaaa", "d", "k")
    assert (shown.asks, shown.asks_id, shown.others) == ("eve", "bbbbbbbb", True)
    assert shown.boot not in ("", "b")
    for over in (False, True):
        second.request("eve", over=over)
    second.request("ann", want="release")
    for at in (100.25, 104.0, 130.0):
        assert not second.tick(at)
    assert second.control.state() == shown


def test_where_names_are_checked_the_account_of_the_holder_counts_at_all() -> None:
    first, second = (Owner(name, ("arm", "serial"), level="named") for name in ("arm", "serial"))
    first.request("page-1/ann")
    second.receive("arm", first.turn)
    first.receive("serial", second.turn)
    key = first.turn.key
    for by, moves in (("page-1", True), ("ann", False), ("", False)):
        assert (first.moves(key, by), second.moves(key, by)) == (moves, moves)
    assert second.control.holds(Drive(z=0.5, key=key, by="page-1/bob"))
