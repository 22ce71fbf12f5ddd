from __future__ import annotations

from pebble.runtime.timers import Timers


def test_timers_run_in_the_order_they_are_due() -> None:
    timers, ran = Timers(), list[str]()

    def first() -> None:
        ran.append("first")
        timers.add(1.5, lambda: ran.append("added"))

    timers.add(2.0, lambda: ran.append("second"))
    timers.add(1.0, first)
    timers.add(1.0, lambda: ran.append("first, added later"))
    timers.run_due(0.5)
    assert ran == []
    timers.run_due(2.0)
    timers.run_due(9.0)
    assert ran == ["first", "first, added later", "added", "second"]


def test_the_wait_is_until_the_next_one() -> None:
    timers = Timers()
    assert timers.wait(0.0) is None
    first = timers.add(5.0, lambda: None)
    timers.add(7.0, lambda: None)
    assert timers.wait(1.0) == 4.0
    assert timers.wait(6.0) == 0.0
    first.cancel()
    assert timers.wait(1.0) == 6.0


def test_a_cancelled_timer_does_not_run_even_when_it_was_due_already() -> None:
    timers, ran = Timers(), list[str]()
    second = timers.add(2.0, lambda: ran.append("second"))
    timers.add(1.0, second.cancel)
    timers.run_due(3.0)
    assert ran == []


def test_a_periodic_timer_keeps_its_rate_and_can_cancel_itself() -> None:
    timers, ran = Timers(), list[int]()

    def tick() -> None:
        ran.append(len(ran))
        if len(ran) == 3:
            timer.cancel()

    timer = timers.add(1.0, tick, period=1.0)
    timers.run_due(1.25)
    assert timers.wait(1.25) == 0.75, "lateness does not add up"
    timers.run_due(2.0)
    timers.run_due(3.0)
    assert ran == [0, 1, 2]
    assert timers.wait(3.0) is None


def test_a_periodic_timer_that_fell_behind_skips_the_missed_turns() -> None:
    timers, ran = Timers(), list[float]()
    timers.add(1.0, lambda: ran.append(0), period=1.0)
    timers.run_due(5.5)
    assert len(ran) == 1
    assert timers.wait(5.5) == 1.0
