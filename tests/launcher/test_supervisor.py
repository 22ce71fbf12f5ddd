from __future__ import annotations

import pytest

from pebble.launcher.supervisor import ALIVE_LIMIT_S, LOOP_RETRY_S, REST_S, START_LIMIT_S, Life


def crash(life: Life, at: float, ran_for: float = 0.0) -> float:
    """One start and one exit; returns how long to wait for the next start."""
    life.started(at)
    return life.exited(at + ran_for, "exit code 1")


def test_a_life_without_trouble() -> None:
    life = Life()
    assert (life.state, life.restarts, life.last_exit, life.settled) == ("init", 0, None, False)
    life.started(0.0)
    assert (life.state, life.settled) == ("init", False)
    life.ready(0.2)
    assert (life.state, life.settled) == ("ready", True)
    life.stopped("exit code 0")
    assert (life.state, life.restarts, life.last_exit) == ("stopped", 0, "exit code 0")


def test_the_first_restart_is_immediate_and_later_ones_wait_longer() -> None:
    life, now, waits = Life(2.0), 0.0, []
    for _ in range(9):
        waits.append(crash(life, now, ran_for=20.0))  # slow enough not to be a crash loop
        now += 20.0 + waits[-1]
    assert waits == [0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 10.0, 10.0, 10.0]
    assert life.state == "restarting"


def test_the_configured_delay_scales_the_waits() -> None:
    life = Life(0.4)
    assert [crash(life, now, ran_for=20.0) for now in (0.0, 30.0, 60.0)] == pytest.approx([0.0, 0.1, 0.2])


def test_five_exits_within_a_minute_are_a_crash_loop_that_is_retried_slowly() -> None:
    life = Life(0.0)
    waits = [crash(life, now) for now in (0.0, 1.0, 2.0, 3.0)]
    assert waits == [0.0] * 4
    assert (life.state, life.looping) == ("restarting", False)
    assert crash(life, 4.0) == LOOP_RETRY_S
    assert (life.state, life.looping) == ("failed", True)
    assert crash(life, 14.0) == LOOP_RETRY_S
    assert life.restarts == 5
    life.started(24.0)
    assert life.state == "failed", "an attempt is not yet a success"
    life.ready(24.1)
    assert life.state == "ready"


def test_a_stable_minute_clears_the_record() -> None:
    life = Life(0.0)
    for now in range(5):
        crash(life, float(now))
    assert life.looping
    assert crash(life, 20.0, ran_for=60.0) == 0.0
    assert (life.state, life.looping) == ("restarting", False)


def test_a_thousand_exits_are_no_problem() -> None:
    life = Life(2.0)
    waits = [crash(life, now * 100.0, ran_for=30.0) for now in range(1000)]
    assert max(waits) == 10.0


def test_silence_makes_it_stuck_later_at_the_start_than_afterwards() -> None:
    life = Life()
    assert life.stuck_at == float("inf")
    life.started(100.0)
    assert life.stuck_at == 100.0 + START_LIMIT_S
    life.ready(101.0)
    assert life.stuck_at == 101.0 + ALIVE_LIMIT_S
    life.alive(105.0)
    assert life.stuck_at == 105.0 + ALIVE_LIMIT_S
    life.exited(106.0, "signal 9")
    assert life.stuck_at == float("inf")


def test_stopping_one_that_does_not_run_keeps_its_last_exit() -> None:
    life = Life()
    crash(life, 0.0)
    life.stopped(None)
    assert (life.state, life.last_exit) == ("stopped", "exit code 1")


def test_started_anew_after_it_was_asked_to_stop_is_no_restart() -> None:
    life = Life()
    life.started(0.0)
    life.ready(0.5)
    life.stopped("exit code 0")
    life.started(10.0)
    assert (life.state, life.restarts, life.last_exit) == ("init", 0, "exit code 0")
    life.exited(11.0, "signal 9")
    life.started(11.0)
    assert life.restarts == 1


def test_a_program_rests_between_two_starts() -> None:
    life = Life()
    assert life.rest_s(0.0) == 0.0
    life.started(5.0)
    life.stopped("exit code 0")
    assert life.rest_s(5.25) == REST_S - 0.25
    assert life.rest_s(5.0 + REST_S) == 0.0
