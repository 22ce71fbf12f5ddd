"""Moments at a fixed distance."""

from common.ticks import Grid

WRAP = 1 << 30


def test_the_first_is_one_period_away():
    grid = Grid(20, 100)
    assert [now for now in range(100, 181) if grid.due(now)] == [120, 140, 160, 180]


def test_being_late_delays_nothing_later():
    grid = Grid(20, 0)
    assert [now for now in (0, 19, 27, 39, 41, 59, 60, 61) if grid.due(now)] == [27, 41, 60]


def test_what_a_pause_missed_is_not_made_up_for():
    grid = Grid(20, 0)
    assert grid.due(3005)
    assert not grid.due(3006)
    assert not grid.due(3019)
    assert grid.due(3020)


def test_the_ticks_may_wrap():
    grid = Grid(20, WRAP - 50)
    assert [step for step in range(101) if grid.due((WRAP - 50 + step) % WRAP)] == [20, 40, 60, 80, 100]
