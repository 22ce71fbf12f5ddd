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


def test_a_grid_is_due_once_per_period_makes_up_for_nothing_and_is_delayed_by_nothing() -> None:
    for start in (0, LAST - 50):
        grid = Grid(100, start)
        times = (0, 99, 100, 101, 135, 199, 207, 299, 300, 1250, 1251, 1299, 1300)
        assert [ms for ms in times if grid.due(add(start, ms))] == [100, 207, 300, 1250, 1300]
