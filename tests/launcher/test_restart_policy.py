from __future__ import annotations

import pytest

from pebble.launcher.restart_policy import ALIVE_LIMIT_S, LOOP_RETRY_S, START_INTERVAL_S, START_LIMIT_S, RestartPolicy


def crash(policy: RestartPolicy, at: float, ran_for: float = 0.0) -> float:
    """One start and one exit; returns how long to wait for the next start."""
    policy.started(at)
    return policy.exited(at + ran_for, "exit code 1")


def test_a_start_after_a_requested_end_is_no_restart() -> None:
    policy = RestartPolicy()
    assert (policy.state, policy.restarts, policy.last_exit, policy.first_attempt_done) == ("init", 0, None, False)
    policy.started(0.0)
    assert (policy.state, policy.first_attempt_done) == ("init", False)
    policy.ready(0.2)
    assert (policy.state, policy.first_attempt_done) == ("ready", True)
    policy.stopped("exit code 0")
    assert (policy.state, policy.restarts, policy.last_exit) == ("stopped", 0, "exit code 0")
    policy.started(10.0)
    assert (policy.state, policy.restarts, policy.last_exit) == ("init", 0, "exit code 0")
    crash(policy, 11.0)
    policy.stopped(None)
    assert (policy.state, policy.restarts, policy.last_exit) == ("stopped", 1, "exit code 1"), "of what ran last"


@pytest.mark.parametrize(
    ("delay_s", "expected"), [(2.0, [0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 10.0, 10.0, 10.0]), (0.4, [0.0, 0.1, 0.2])]
)
def test_the_first_restart_is_immediate_and_later_ones_wait_longer(delay_s: float, expected: list[float]) -> None:
    policy, now, waits = RestartPolicy(delay_s), 0.0, []
    for _ in expected:
        waits.append(crash(policy, now, ran_for=20.0))  # slow enough not to be a crash loop
        now += 20.0 + waits[-1]
    assert waits == pytest.approx(expected)
    assert policy.state == "restarting"


def test_five_exits_within_a_minute_are_a_crash_loop_that_is_retried_slowly() -> None:
    policy = RestartPolicy(0.0)
    waits = [crash(policy, now) for now in (0.0, 1.0, 2.0, 3.0)]
    assert waits == [0.0] * 4
    assert (policy.state, policy.in_crash_loop) == ("restarting", False)
    assert crash(policy, 4.0) == LOOP_RETRY_S
    assert (policy.state, policy.in_crash_loop) == ("failed", True)
    assert crash(policy, 14.0) == LOOP_RETRY_S
    assert policy.restarts == 5
    policy.started(24.0)
    assert policy.state == "failed", "an attempt is not yet a success"
    policy.ready(24.1)
    assert policy.state == "ready"


def test_a_stable_minute_clears_the_record() -> None:
    policy = RestartPolicy(0.0)
    for now in range(5):
        crash(policy, float(now))
    assert policy.in_crash_loop
    assert crash(policy, 20.0, ran_for=60.0) == 0.0
    assert (policy.state, policy.in_crash_loop) == ("restarting", False)


def test_silence_makes_it_stuck_later_at_the_start_than_afterwards() -> None:
    policy = RestartPolicy()
    assert policy.stuck_at == float("inf")
    policy.started(100.0)
    assert policy.stuck_at == 100.0 + START_LIMIT_S
    policy.ready(101.0)
    assert policy.stuck_at == 101.0 + ALIVE_LIMIT_S
    policy.alive(105.0)
    assert policy.stuck_at == 105.0 + ALIVE_LIMIT_S
    policy.exited(106.0, "signal 9")
    assert policy.stuck_at == float("inf")


def test_a_program_rests_between_two_starts() -> None:
    policy = RestartPolicy()
    assert policy.request_delay_s(0.0) == 0.0
    policy.started(5.0)
    policy.stopped("exit code 0")
    assert policy.request_delay_s(5.25) == START_INTERVAL_S - 0.25
    assert policy.request_delay_s(5.0 + START_INTERVAL_S) == 0.0
