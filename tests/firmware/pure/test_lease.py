"""Who has control: the table of states, one row each, and what a drive command with or without a key may do."""

from common.lease import Lease, request_of
from common.ticks import add, diff

NAME = "00000000000000aa"
DRIVE = 0
ANN, OTTO, MIA = ("", "aaaaaaaa", "ann", "phone"), ("", "00000001", "otto", ""), ("", "00000002", "mia", "")
WRAPS = (1 << 30) - 4000  # of a board's clock, within each test


class Keys:
    made = 0

    def __call__(self, count: int) -> str:
        assert count == 4
        self.made += 1
        return f"{self.made:08x}"


def lease(strangers: int = DRIVE) -> Lease:
    return Lease(WRAPS, diff, Keys(), strangers)


def name_of(client: tuple) -> str:
    return client[2] if client else ""


def after(ms: int) -> int:
    return add(WRAPS, ms)


def perform(own: Lease, event: tuple) -> None:
    at, what, who = event[:3]
    now = after(at)
    if what == "hold" or what == "take":
        own.hold(who, event[3] if len(event) > 3 else 3000, what == "take", now)
    elif what == "release":
        own.release(who, now)
    elif what == "tick":
        own.tick(now)
    else:
        own.tick(now)
        assert not own.refuses(what == "moves", False, own.key, who[0], now)


#: What happens, as (milliseconds, event, who); who has control then, who asks for it, and how many keys there were.
HISTORIES = (
    ((), "", "", 0),
    (((0, "hold", ANN),), "ann", "", 1),
    (((0, "take", ANN),), "ann", "", 1),
    (((0, "hold", ANN), (2999, "tick", ANN)), "ann", "", 1),
    (((0, "hold", ANN), (3000, "tick", ANN)), "", "", 1),
    (((0, "hold", ANN), (2999, "hold", ANN), (5998, "tick", ANN)), "ann", "", 1),
    (((0, "hold", ANN), (2999, "moves", ANN), (5998, "tick", ANN)), "ann", "", 1),
    (((0, "hold", ANN), (2999, "zero", ANN), (5998, "tick", ANN)), "ann", "", 1),
    (((0, "hold", ANN, 0), (999, "tick", ANN)), "ann", "", 1),
    (((0, "hold", ANN, 0), (1000, "tick", ANN)), "", "", 1),
    (((0, "hold", ANN, 99999), (9999, "tick", ANN)), "ann", "", 1),
    (((0, "hold", ANN, 99999), (10000, "tick", ANN)), "", "", 1),
    (((0, "hold", ANN), (3000, "hold", ANN)), "ann", "", 2),  # it came too late, and the old key is void
    (((0, "hold", ANN), (10, "hold", OTTO)), "ann", "otto", 1),
    (((0, "hold", ANN), (10, "hold", OTTO), (20, "hold", MIA)), "ann", "otto", 1),
    (((0, "hold", ANN, 9999), (10, "hold", OTTO), (3010, "hold", MIA)), "ann", "mia", 1),  # otto has not repeated it
    (((0, "hold", ANN, 9999), (10, "hold", OTTO), (3009, "hold", OTTO), (3010, "hold", MIA)), "ann", "otto", 1),
    (((0, "hold", ANN, 9999), (10, "hold", OTTO), (20, "release", OTTO)), "ann", "", 1),
    (((0, "hold", ANN, 9999), (10, "hold", OTTO), (20, "release", MIA)), "ann", "otto", 1),
    (((0, "hold", ANN, 9999), (4999, "hold", OTTO)), "ann", "otto", 1),
    (((0, "hold", ANN, 9999), (5000, "hold", OTTO)), "otto", "", 2),
    (((0, "hold", ANN, 9999), (4000, "moves", ANN), (8999, "hold", OTTO)), "ann", "otto", 1),
    (((0, "hold", ANN, 9999), (4000, "zero", ANN), (5000, "hold", OTTO)), "otto", "", 2),
    (((0, "hold", ANN, 9999), (4000, "hold", OTTO), (5000, "tick", ANN)), "otto", "", 2),
    (((0, "hold", ANN, 9999), (4000, "hold", OTTO), (5000, "hold", MIA)), "otto", "mia", 2),  # otto was first
    (((0, "hold", ANN), (10, "take", OTTO)), "otto", "", 2),
    (((0, "hold", ANN), (10, "hold", OTTO), (20, "take", MIA)), "mia", "", 2),
    (((0, "hold", ANN), (10, "take", ANN)), "ann", "", 1),
    (((0, "hold", ANN), (10, "release", ANN)), "", "", 1),
    (((0, "hold", ANN), (10, "release", OTTO)), "ann", "", 1),
    (((0, "hold", ANN), (10, "hold", OTTO), (20, "release", ANN)), "otto", "", 2),
    (((0, "hold", ANN), (10, "hold", OTTO), (2990, "hold", OTTO), (3000, "tick", ANN)), "otto", "", 2),
    (((0, "hold", ANN), (10, "hold", OTTO, 9999), (3000, "tick", ANN), (12998, "tick", ANN)), "otto", "", 2),
    (((0, "hold", ANN), (10, "hold", OTTO, 9999), (3000, "release", OTTO)), "", "", 2),  # it had got control
    (((0, "release", ANN),), "", "", 0),
)


def test_the_table_of_states() -> None:
    for events, by, asks, keys in HISTORIES:
        random = Keys()
        own = Lease(WRAPS, diff, random, DRIVE)
        for event in events:
            perform(own, event)
        assert (name_of(own.holder), name_of(own.asker), random.made) == (by, asks, keys), events
        assert (own.key != "") == (by != ""), events


def test_a_state_changes_and_the_motors_are_halted_only_where_something_changes() -> None:
    for events, changed, halts in (
        (((0, "hold", ANN),), True, True),
        (((0, "hold", ANN), (9, "hold", ANN)), False, False),
        (((0, "hold", ANN), (9, "moves", ANN)), False, False),
        (((0, "hold", ANN), (9, "hold", OTTO)), True, False),
        (((0, "hold", ANN), (9, "hold", OTTO), (19, "hold", OTTO)), False, False),
        (((0, "hold", ANN), (9, "hold", OTTO), (19, "hold", MIA)), False, False),
        (((0, "hold", ANN), (9, "take", OTTO)), True, True),
        (((0, "hold", ANN), (9, "release", ANN)), True, True),
        (((0, "hold", ANN), (9, "release", OTTO)), False, False),
        (((0, "hold", ANN), (3000, "tick", ANN)), True, True),
    ):
        own = lease()
        assert own.changed  # the first state is to be published
        assert not own.halts
        for event in events:
            own.changed = own.halts = False
            perform(own, event)
        assert (own.changed, own.halts) == (changed, halts), events


def test_it_shows_that_others_drive_too_for_a_while() -> None:
    own = lease()
    assert not own.refuses(True, False, "", "", WRAPS)
    assert own.others
    own.changed = False
    for now in (1999, 3998):
        own.tick(after(now))
        assert own.others
        assert not own.changed
        assert own.refuses(True, False, "", "", after(1999)) is False
    own.tick(after(3999))
    assert own.changed
    assert not own.others


def test_what_a_request_is() -> None:
    for fields, request in (
        ({"id": "3f2a91c0"}, ("3f2a91c0", "", "", 3000)),
        ({"id": "3F2A91C0", "want": "hold", "by": "Ann", "device": "x" * 30}, ("3F2A91C0", "ann", "x" * 20, 3000)),
        ({"id": "3f2a91c0", "want": "release"}, ("3f2a91c0", "", "", 0)),
        ({"id": "3f2a91c0", "for_ms": 0}, ("3f2a91c0", "", "", 1)),
        ({"id": "3f2a91c0", "for_ms": 1500.5}, ("3f2a91c0", "", "", 1500)),
        ({"id": "3f2a91c0", "for_ms": 1e30}, ("3f2a91c0", "", "", 10_000)),
        ({}, None), ({"id": ""}, None), ({"id": 7}, None), ({"id": "3f2a91c"}, None), ({"id": "3f2a91cg"}, None),
        ({"id": "3f2a91c0", "want": "drive"}, None), ({"id": "3f2a91c0", "want": None}, None),
        ({"id": "3f2a91c0", "for_ms": "1"}, None), ({"id": "3f2a91c0", "for_ms": True}, None),
        ({"id": "3f2a91c0", "by": 1}, None), ({"id": "3f2a91c0", "device": None}, None),
    ):  # fmt: skip
        assert request_of(fields) == request, fields


def test_keys_of_several_owners_are_shorter_than_80_letters() -> None:
    own = lease()
    own.hold(ANN, 3000, False, after(0))
    for others, holds in ((0, True), (70, True), (71, False), (700, False)):
        assert own.holds(("x" * others + " " if others else "") + own.key, "") is holds
