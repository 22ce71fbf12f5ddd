"""Times that wrap, in CPython and in MicroPython."""

from common.ticks import Grid, add, diff

LAST = (1 << 30) - 1


def test_differences_go_over_the_wrap() -> None:
    assert diff(5, 3) == 2
    assert diff(3, 5) == -2
    assert diff(2, LAST) == 3
    assert diff(LAST, 2) == -3
    assert diff(LAST, LAST) == 0


def test_half_the_period_is_as_far_as_it_sees() -> None:
    assert diff((1 << 29) - 1, 0) == (1 << 29) - 1
    assert diff(1 << 29, 0) == -(1 << 29)


def test_adding_wraps() -> None:
    assert add(LAST, 1) == 0
    assert add(LAST - 5, 905) == 899
    assert diff(add(LAST - 5, 905), LAST - 5) == 905


def test_a_grid_is_due_once_per_period_and_makes_up_for_nothing() -> None:
    grid = Grid(100, LAST - 50)
    seen = [ms for ms in range(0, 260, 10) if grid.due(add(LAST - 50, ms))]
    assert seen == [100, 200]
    assert grid.due(add(LAST - 50, 1250))
    assert not grid.due(add(LAST - 50, 1299))
    assert grid.due(add(LAST - 50, 1300))
