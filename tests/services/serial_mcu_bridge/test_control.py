"""Control of a Linux robot's motors: what its owner publishes, what several owners take from one another, silence.

The rules of the lease: tests/motion. With whole owners: tests/robot.
"""

from __future__ import annotations

import logging
import operator
from typing import Any

import pytest
from msgspec import structs

from pebble.config import Security
from pebble.contract import CONTROL_STATE, codec
from pebble.contract.payloads import ControlRequest, ControlState, ControlTurn, Drive
from pebble.motors.control import Control
from pebble.motors.shared_lease import SharedLease


def test_states_are_published_when_they_change_and_not_more_than_four_times_a_second(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    states: list[ControlState] = []
    control = Control(Security(), states.append, 100.0)
    control.note(100.0)
    assert [state.key for state in states] == [""]
    for number in range(1000):  # a flood of people who ask, and release
        control.request(ControlRequest(id=f"{number:08x}", by=f"mia{number}"), over=True, now=100.0)
        assert control.note(100.0)
    assert len(states) == 4
    now = 100.0
    while control.due is not None:
        now = control.due
        control.tick(now)
        control.note(now)
    assert len(states) == 6  # the newest as soon as it may be, and that control is free again
    assert states[4].by == "mia999"
    assert (states[5].key, now) == ("", pytest.approx(103.0, abs=0.3))
    control.repeat_state(now + 5)
    assert states[6:] == [control.state()] == [states[5]]
    assert caplog.messages == [f"mia{number} has control" for number in range(5)]


def test_a_state_is_short() -> None:
    states: list[ControlState] = []
    control = Control(Security(), states.append, 0.0)
    for over, name in ((True, "aaaaaaaa"), (False, "bbbbbbbb")):
        control.request(ControlRequest(id=name, by="z" * 50, device="z" * 50), over=over, now=0.0)
    control.note(0.0)
    raw = codec.encode(CONTROL_STATE, states[-1])
    assert states[-1].asks == "z" * 40
    assert len(raw) <= 300
    assert codec.decode(CONTROL_STATE, raw) == states[-1]


# -- several owners


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
    (granted(t=100_500, turn=0, key="l", boot="c"), True, "l"),
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


# -- a lease whose holder is quiet only while the bridge vouches


ANN, EVE = ("", "aaaaaaaa", "ann", ""), ("", "eeeeeeee", "eve", "")

#: What happens, as (seconds, event, ...), and who has control then. She asks for 3 s unless a row says otherwise.
HISTORIES: dict[str, tuple[tuple[Any, ...], ...]] = {
    "silence that nothing vouches for": ((0, "hold", ANN), (3, "ann"), (29.999, "ann"), (30, "")),
    "silence that the bridge vouches for": (
        *((0, "hold", ANN), (3.2, "vouch", 0, 2.999), (3.2, "ann"), (3.3, "vouch", 0, 3), (3.3, "")),
    ),
    "only from the beginning of what it vouches for": (
        *((0, "hold", ANN), (6, "vouch", 3, 5.999), (6, "ann"), (6.5, "vouch", 3, 6), (6.5, "")),
    ),
    "it is counted anew after what was late": (
        *((0, "hold", ANN), (2.9, "vouch", 0, 2.9), (8, "vouch", 8, 8), (8, "ann")),
        *((10.9, "vouch", 8, 10.9), (10.9, "ann"), (11, "vouch", 8, 11), (11, "")),
    ),
    "30 s also while the bridge vouches for nothing but now": (
        *((0, "hold", ANN), (29.9, "vouch", 29.9, 29.9), (29.999, "ann"), (30, "")),
    ),
    "a request renews it, and so does a zero": (
        *((0, "hold", ANN), (2, "hold", ANN), (4, "vouch", 0, 4), (4, "ann"), (4.5, "zero")),
        *((7, "vouch", 0, 7), (7, "ann"), (7.5, "vouch", 0, 7.5), (7.5, "")),
    ),
    "a time to come is of another clock, and so is one that ends before it begins": (
        *((0, "hold", ANN), (3, "vouch", 0, 3.001), (3, "ann"), (9, "vouch", 5, 4), (9, "ann"), (9, "vouch", 5, 9)),
        (9, ""),
    ),
    "what may have been lost between the bridge and here": (
        *((0, "hold", ANN), (2, "doubt"), (4, "vouch", 0, 4), (4, "ann"), (4.999, "vouch", 0, 4.999), (4.999, "ann")),
        *((5, "vouch", 0, 5), (5, "")),
    ),
    "who asks waits for five idle seconds": (
        *((0, "hold", ANN, 10), (1, "moves"), (2, "hold", EVE, 10), (6.1, "vouch", 0, 5.999), (6.1, "ann")),
        *((6.2, "vouch", 0, 6), (6.2, "eve")),
    ),
    "idle seconds that nothing vouches for": (
        *((0, "hold", ANN, 10), (1, "moves"), *((at, "hold", EVE, 10) for at in (2, 11, 20, 29))),
        *((29, "hold", ANN), (30.999, "ann"), (31, "eve")),
    ),
    "idle seconds that counted once, and do no more": (
        *((0, "hold", ANN, 10), (5, "vouch", 0, 5), (5, "ann"), (6, "vouch", 6, 6), (6, "hold", EVE), (6, "ann")),
    ),
    "who moved long ago gives way at once": ((0, "hold", ANN, 10), (5, "vouch", 0, 5), (5, "hold", EVE), (5, "eve")),
}  # fmt: skip


def vouched_lease(vouched: tuple[int, int] | None) -> SharedLease:
    made = SharedLease(frozenset(), 0, operator.sub, "{:08x}".format, 0)
    made.vouched = vouched
    return made


def perform(own: SharedLease, events: tuple[tuple[Any, ...], ...]) -> None:
    for at, what, *rest in events:
        now = round(1000 * at)
        if what == "hold":
            own.hold(rest[0], 1000 * (rest[1] if rest[1:] else 3), False, now)
        elif what == "vouch":
            own.vouch(round(1000 * rest[0]), round(1000 * rest[1]), now)
        elif what == "doubt":
            own.doubt(now)
        elif what in ("moves", "zero"):
            own.tick(now)
            assert not own.refuses(what == "moves", False, own.key, "", now)
        else:
            own.tick(now)
            assert (own.holder[2] if own.holder else "") == what, f"after {at} s"


@pytest.mark.parametrize("name", HISTORIES)
def test_silence(name: str) -> None:
    perform(vouched_lease((0, 0)), HISTORIES[name])


def test_without_a_bridge_all_time_counts() -> None:
    own = vouched_lease(None)
    perform(own, ((0, "hold", ANN), (2.999, "vouch", 2, 2.999), (2.999, "ann"), (2.999, "doubt"), (3, "")))
    assert own.vouched is None
    assert not own.refuses(True, False, "", "", 3000)  # a stranger's
    own.changed = False
    own.tick(5000)
    assert (own.others, own.changed) == (False, True)
