"""The emergency stop, and who has control: what latches and resets, what is saved, and each change of the lease."""

from common.latch import Latch, reset_of, stop_of
from common.lease import Lease, request_of
from common.ticks import add, diff

A, B, C = "00000000000000aa", "00000000000000bb", "00000000000000cc"


def stopped(*names: str) -> Latch:
    latch = Latch("0badcafe", 2, diff)
    for name in names:
        latch.stop(name, "ann", "test", 5)
    return latch


def test_a_sender_that_was_not_checked_gives_way_to_one_that_was() -> None:
    latch = stopped(B)
    for by, shown in (("otto?", "otto?"), ("", "otto?"), ("ann?", "otto?"), ("ann", "ann"), ("vera", "ann")):
        assert latch.stop(A, by, "", 9) == (by == "otto?")
        assert (latch.by, latch.count) == (shown, 2)
    latch.stop(C, "otto?", "", 9)
    latch.stop(A, "vera", "", 9)  # of an older stop
    assert latch.by == "otto?"


def test_the_name_of_a_stop_stays_while_another_sender_floods() -> None:
    """Else a state, of which there are four a second, might never have it, and the stop would not be confirmed."""
    latch = Latch("0badcafe", 4, diff)
    latch.restore({"latched": False, "recent": [B, C]})
    latch.stop(A, "otto?", "", 5)
    latch.stop(A, "otto", "", 5)
    for number in range(1000):
        latch.stop(f"e{number:015x}", ("vera", "vera/pad", "vera/desk")[number % 3], "", 5)
        latch.stop(f"f{number:015x}", f"p{number}?", "", 5)
    vera, claimed = "e0000000000003e7", ["f0000000000003e7", "f0000000000003e6"]
    assert latch.recent == [claimed[0], vera, claimed[1], A]
    assert latch.count == 2001


def test_what_is_saved_restores_all_but_boot_and_count() -> None:
    again = Latch("12345678", 2, diff)
    again.restore(stopped(A, B).saved())
    assert (again.latched, again.recent, again.by, again.why, again.since) == (True, [B, A], "ann", "test", 5)
    assert (again.boot, again.count) == ("12345678", 0)
    assert not again.stop(B, "ann", "", 6)
    free = stopped(A)
    free.reset("0badcafe", 1, 0, 0)
    again.restore(free.saved())
    assert not again.latched


def test_what_is_not_ours_is_a_stop() -> None:
    for saved in (None, {}, [], 1, {"latched": 0, "recent": []}, {"latched": False}, {"latched": False, "recent": 3}):
        latch = stopped()
        latch.restore(saved)
        assert latch.latched, saved
        assert latch.why == "the saved state cannot be read"


def test_odd_fields_in_a_saved_state_are_left_out() -> None:
    latch = stopped()
    latch.restore({"latched": False, "recent": [A, 5, "x", B, C], "by": 7, "why": 'a"b\\c\n', "since": "now"})
    assert (latch.latched, latch.recent, latch.by, latch.why, latch.since) == (False, [A, B], "", "a?b?c?", 0)


def test_a_stop_of_any_shape() -> None:
    assert stop_of({"stop": A, "by": "ann", "why": "w"}) == (A, "ann", "w")
    assert stop_of({"value": {"stop": A, "by": "b" * 99, "why": "w" * 99}}) == (A, "b" * 32, "w" * 40)
    for body in (None, 5, [], {}, "x", {"stop": 5, "by": [], "why": {}}, {"value": 3}):
        assert stop_of(body) == ("", "", ""), body


def test_a_reset_has_a_boot_and_a_count() -> None:
    assert reset_of({"boot": "x", "count": 3}) == ("x", 3)
    assert reset_of({"value": {"boot": "x", "count": 3}}) == ("x", 3)
    for body in (None, [], {}, {"boot": "x"}, {"boot": 5, "count": 3}, {"boot": "x", "count": True}):
        assert reset_of(body) is None, body


ANN, OTTO, MIA = ("", "aaaaaaaa", "ann", "phone"), ("", "00000001", "otto", ""), ("", "00000002", "mia", "")
START = (1 << 30) - 2000  # of a board's clock, which wraps within each history

#: What happens, as (milliseconds, event, who); then who has control, who asks for it, whether there is a new state to
#: publish, and whether the motors are to be halted. All histories: tests/motion.
HISTORIES = (
    (((0, "hold", ANN),), ANN, (), True, True),
    (((0, "hold", ANN), (9, "moves", ANN)), ANN, (), False, False),
    (((0, "hold", ANN), (9, "hold", OTTO)), ANN, OTTO, True, False),
    (((0, "hold", ANN), (9, "hold", OTTO), (19, "hold", MIA)), ANN, OTTO, False, False),
    (((0, "hold", ANN), (9, "take", OTTO)), OTTO, (), True, True),
    (((0, "hold", ANN), (9, "release", ANN)), (), (), True, True),
    (((0, "hold", ANN), (9, "release", OTTO)), ANN, (), False, False),
    (((0, "hold", ANN), (9, "hold", OTTO), (19, "release", OTTO)), ANN, (), True, False),
    (((0, "hold", ANN), (2999, "tick", ANN)), ANN, (), False, False),
    (((0, "hold", ANN), (3000, "tick", ANN)), (), (), True, True),
)


def lease() -> Lease:
    return Lease(START, diff, lambda count: "a" * (2 * count), 0)


def test_a_state_changes_and_the_motors_are_halted_only_where_something_changes() -> None:
    for events, holder, asker, changed, halts in HISTORIES:
        own = lease()
        assert own.changed  # the first state is to be published
        assert not own.halts
        for ms, what, who in events:
            own.changed = own.halts = False
            now = add(START, ms)
            own.tick(now)
            if what == "moves":
                assert not own.refuses(True, False, own.key, who[0], now)
            elif what == "release":
                own.release(who, now)
            elif what != "tick":
                own.hold(who, 3000, what == "take", now)
        assert (own.holder, own.asker, own.changed, own.halts) == (holder, asker, changed, halts), events


def test_what_a_request_is() -> None:
    for fields, request in (
        ({"id": "3f2a91c0"}, ("3f2a91c0", "", "", 3000)),
        ({"id": "3F2A91C0", "want": "hold", "by": "Ann", "device": "x" * 30}, ("3F2A91C0", "ann", "x" * 20, 3000)),
        ({"id": "3f2a91c0", "want": "release"}, ("3f2a91c0", "", "", 0)),
        ({"id": "3f2a91c0", "for_ms": 0}, ("3f2a91c0", "", "", 1)),
        ({"id": "3f2a91c0", "for_ms": 1e30}, ("3f2a91c0", "", "", 10_000)),
        ({}, None), ({"id": 7}, None), ({"id": "3f2a91c"}, None), ({"id": "3f2a91cg"}, None),
        ({"id": "3f2a91c0", "want": "drive"}, None), ({"id": "3f2a91c0", "for_ms": True}, None),
        ({"id": "3f2a91c0", "by": 1}, None), ({"id": "3f2a91c0", "device": None}, None),
    ):  # fmt: skip
        assert request_of(fields) == request, fields


def test_keys_of_several_owners_are_shorter_than_80_letters() -> None:
    own = lease()
    own.hold(ANN, 3000, False, START)
    for others, holds in ((0, True), (70, True), (71, False), (700, False)):
        assert own.holds(("x" * others + " " if others else "") + own.key, "") is holds
