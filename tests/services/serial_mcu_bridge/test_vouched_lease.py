"""A lease whose holder is quiet only while the bridge vouches: histories as rows. With whole owners: tests/robot."""

from __future__ import annotations

import operator
from typing import Any

import pytest

from pebble.motors.vouched_lease import VouchedLease

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
    "a time to come is of another clock": (
        *((0, "hold", ANN), (3, "vouch", 0, 3.001), (3, "ann"), (3, "vouch", 0, 3), (3, "")),
    ),
    "so is one that ends before it begins": (
        *((0, "hold", ANN), (9, "vouch", 5, 4), (9, "ann"), (9, "vouch", 5, 9), (9, "")),
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
    "it is taken over, and released, at once": (
        *((0, "hold", ANN), (1, "take", EVE), (1, "eve"), (2, "release", EVE), (2, "")),
    ),
}  # fmt: skip


def lease(vouched: tuple[int, int] | None) -> VouchedLease:
    made = VouchedLease(0, operator.sub, "{:08x}".format, 0)
    made.vouched = vouched
    return made


def perform(own: VouchedLease, events: tuple[tuple[Any, ...], ...]) -> None:
    for at, what, *rest in events:
        now = round(1000 * at)
        if what in ("hold", "take"):
            own.hold(rest[0], 1000 * (rest[1] if rest[1:] else 3), what == "take", now)
        elif what == "release":
            own.release(rest[0], now)
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
    perform(lease((0, 0)), HISTORIES[name])


def test_without_a_bridge_all_time_counts() -> None:
    own = lease(None)
    perform(own, ((0, "hold", ANN), (2.999, "vouch", 2, 2.999), (2.999, "ann"), (2.999, "doubt"), (3, "")))
    assert own.vouched is None
