"""The time of day from ticks."""

from common.ticks import add
from common.wall import Wall

LAST = (1 << 30) - 1


def test_before_any_answer_it_counts_from_the_start() -> None:
    wall = Wall(500)
    assert wall.read(500) == 0
    assert wall.read(750) == 250


def test_after_an_answer_it_goes_on_from_there() -> None:
    wall = Wall(0)
    wall.set(1700000000123, 1000)
    assert wall.read(1250) == 1700000000373


def test_ticks_may_wrap_as_often_as_they_like() -> None:
    wall = Wall(LAST - 1000)
    wall.set(1700000000000, LAST - 1000)
    now, day = LAST - 1000, 86400000
    for days in range(1, 40):
        now = add(now, day)
        assert wall.read(now) == 1700000000000 + days * day
