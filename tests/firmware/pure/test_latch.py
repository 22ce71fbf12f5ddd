"""The emergency stop: what latches it, what resets it, and what survives a restart."""

from common.latch import Latch, reset_of, stop_of
from common.ticks import diff

A, B, C = "00000000000000aa", "00000000000000bb", "00000000000000cc"


def stopped(*names: str) -> Latch:
    latch = Latch("0badcafe", 2, diff)
    for name in names:
        latch.stop(name, "ann", "test", 5)
    return latch


def test_a_sender_that_was_not_checked_gives_way_to_one_that_was() -> None:
    latch = stopped(B)
    for by, shown in (
        ("otto?", "otto?"),
        ("", "otto?"),
        ("ann?", "otto?"),
        ("ann", "ann"),
        ("vera", "ann"),
        ("x?", "ann"),
    ):
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
