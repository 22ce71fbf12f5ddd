"""Steering and throttle to wheels."""

from common.wheels import clamp, mix


def test_mixing() -> None:
    assert mix(0.0, 1.0) == (1.0, 1.0)
    assert mix(0.0, -0.5) == (-0.5, -0.5)
    assert mix(0.25, 0.5) == (0.75, 0.25)  # to the right: the left wheel is faster
    assert mix(-1.0, 0.0) == (-1.0, 1.0)


def test_nothing_beyond_full_speed() -> None:
    assert mix(1.0, 1.0) == (1.0, 0.0)
    assert mix(-1.0, -1.0) == (-1.0, 0.0)
    assert (clamp(7.0), clamp(-7.0), clamp(0.25)) == (1.0, -1.0, 0.25)
