"""Who gets a place in a full table of components, and whose."""

from __future__ import annotations

from typing import NamedTuple

import pytest

from pebble.client.rank import Rank, RankedTable

MOST, SHARE = 160, 10


class One(NamedTuple):
    rank: Rank


#: What may be seen of a component, from the least on.
RANKS = {
    "remembered": Rank(),
    "heartbeats": Rank(live=True),
    "remembered capabilities": Rank(has_capabilities=True),
    "capabilities and heartbeats": Rank(has_capabilities=True, live=True),
    "known, silent": Rank(known=True),
    "known": Rank(known=True, has_capabilities=True, live=True),
    "remembered state": Rank(has_state=True, has_capabilities=True),
    "all": Rank(has_state=True, has_capabilities=True, live=True),
    "known, with a state": Rank(known=True, has_state=True, has_capabilities=True, live=True),
}
STRANGERS = [name for name in RANKS if "known" not in name]


def let_in(table: RankedTable[One], base: str, rank: Rank) -> bool:
    """Whether it gets a place."""
    if table.refuses(rank) or not table.make_room(rank, table.pop):
        return False
    table[base] = One(rank)
    return True


def crowded(crowd: str, *first: str) -> RankedTable[One]:
    """More of a crowd than there are places have come after these."""
    table = RankedTable[One](MOST, SHARE)
    for number, name in enumerate((*first, *[crowd] * 2 * MOST)):
        let_in(table, str(number), RANKS[name])
    assert len(table) == MOST
    return table


@pytest.mark.parametrize("robot", RANKS)
@pytest.mark.parametrize("crowd", STRANGERS)
def test_no_crowd_of_strangers_gets_the_place_of_a_robot(crowd: str, robot: str) -> None:
    assert "0" in crowded(crowd, robot)


@pytest.mark.parametrize("robot", RANKS)
@pytest.mark.parametrize("crowd", STRANGERS)
def test_a_robot_gets_a_place_where_a_crowd_differs_from_it(crowd: str, robot: str) -> None:
    assert let_in(crowded(crowd), "robot", RANKS[robot]) is (crowd != robot)


@pytest.mark.parametrize("robot", RANKS)
@pytest.mark.parametrize("crowd", [name for name in RANKS if "known" in name])
def test_what_people_have_used_or_opened_gets_any_place_but_those_of_its_like(crowd: str, robot: str) -> None:
    assert ("0" in crowded(crowd, robot)) is ("known" in robot)
    assert not let_in(crowded(crowd), "robot", RANKS[robot])


def test_crowds_of_every_kind_leave_to_each_its_share_and_to_the_first_their_places() -> None:
    """They come one after another, and then all at once."""
    table = RankedTable[One](MOST, SHARE)
    real = [(f"{name} {number}", RANKS[name]) for name in RANKS for number in range(SHARE)]
    for base, rank in real:
        assert let_in(table, base, rank)
    for number, name in enumerate([*(one for one in STRANGERS for _ in range(MOST)), *STRANGERS * MOST]):
        let_in(table, str(number), RANKS[name])
        table.ranks_have_changed()
    assert len(table) == MOST
    assert [base for base, _ in real if base not in table] == []


def test_a_rank_that_was_refused_is_tried_again_once_ranks_may_have_changed() -> None:
    table = crowded("heartbeats")
    assert table.refuses(RANKS["heartbeats"])
    table.ranks_have_changed()
    assert not table.refuses(RANKS["heartbeats"])
    assert not let_in(table, "robot", RANKS["heartbeats"])
    assert sum(table.refuses(RANKS["heartbeats"]) for _ in range(2 * MOST)) < 2 * MOST


def test_a_crowd_that_begins_as_one_rank_and_becomes_another_takes_one_place_from_itself() -> None:
    """It gets its share of the rank that it begins as, again and again: the newest of it gives way."""
    table = crowded("all", "all", "capabilities and heartbeats")
    changes = 0
    for number in range(2 * MOST, 3 * MOST):
        if let_in(table, str(number), RANKS["heartbeats"]):
            table[str(number)] = One(RANKS["all"])
            changes += 1
    assert [str(number) in table for number in range(MOST)] == [True] * (MOST - 1) + [False]
    assert changes <= SHARE + 1, "no more until ranks may have changed"


def test_without_shares_the_higher_rank_gets_the_place_but_not_of_a_known_one() -> None:
    table = RankedTable[One](2)
    for name in ("known", "capabilities and heartbeats"):
        assert let_in(table, name, RANKS[name])
    assert not let_in(table, "lower", RANKS["heartbeats"])
    assert let_in(table, "higher", RANKS["all"])
    assert list(table) == ["known", "higher"]


def test_room_for_bytes_is_taken_from_lower_ranks_that_are_not_known() -> None:
    table = RankedTable[One](MOST, SHARE)
    for name, rank in RANKS.items():
        table[name] = One(rank)
    assert table.below(RANKS["all"], lambda _: True) == "remembered"
    assert table.below(RANKS["all"], lambda one: one.rank.live) == "heartbeats"
    assert table.below(RANKS["remembered"], lambda _: True) is None
