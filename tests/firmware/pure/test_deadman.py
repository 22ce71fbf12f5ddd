"""Who stops asking stops moving."""

from common.deadman import DeadMan

LAST = (1 << 30) - 1


def test_it_speaks_once_when_the_time_is_over() -> None:
    man = DeadMan(900)
    man.feed(1000)
    assert not man.expired(1899)
    assert man.expired(1900)
    assert not man.expired(1901)
    assert man.trips == 1


def test_feeding_gives_it_the_whole_time_again() -> None:
    man = DeadMan(900)
    man.feed(0)
    man.feed(800)
    assert not man.expired(1699)
    assert man.expired(1700)


def test_who_rests_is_left_alone() -> None:
    man = DeadMan(900)
    assert not man.expired(5000)
    man.feed(0)
    man.rest()
    assert not man.expired(5000)
    assert man.trips == 0


def test_over_the_wrap_of_the_ticks() -> None:
    man = DeadMan(900)
    man.feed(LAST - 99)
    assert not man.expired(799)
    assert man.expired(800)
