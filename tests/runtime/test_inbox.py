"""What the thread of a service waits for: its inbox, its timers, and its lock."""

from __future__ import annotations

import signal
import threading
import time

import pytest

from pebble.runtime.inbox import Inbox
from pebble.runtime.timers import Timers
from pebble.runtime.work_lock import WorkLock
from tests.support import WAIT_S, cases, until


def drain(inbox: Inbox) -> None:
    while (job := inbox.take(0)) is not None:
        job()


#: What is posted, what runs, and how many are dropped: a number is a job of its own, ``drive.2`` the newest of its
#: kind, and ``STOP`` ends something.
POSTS = {
    "in the order in which they came": ("0 1 2", "0 1 2", 0),
    "the newest takes the place of the one that waits": ("drive.1 lights drive.2", "drive.2 lights", 0),
    "beyond the limit the oldest is dropped": ("0 1 2 3 4 5 6 7 8 9 drive.1 drive.2", "8 9 drive.2", 8),
    "what ends something is not": ("STOP 0 1 2 3 4", "STOP 3 4", 3),
    "and comes after what it ends": ("0 STOP 1 STOP 2", "1 STOP 2", 1),
    "nor for the newest of a kind": ("drive.1 STOP 0 1 2", "drive.1 STOP 2", 2),
    "its newest is the last": ("STOP 0 1 STOP", "0 1 STOP", 0),
    "of too many the oldest": ("A B C D", "B C D", 1),
}


@pytest.mark.parametrize(("posts", "runs", "dropped"), POSTS.values(), ids=POSTS)
def test_posted_jobs_run_in_order_and_newer_ones_replace_older_ones(posts: str, runs: str, dropped: int) -> None:
    inbox, ran = Inbox(limit=3), list[str]()
    for word in posts.split():
        kind = word.partition(".")[0]
        name = {} if kind.isdigit() else {"last_of" if kind.isupper() else "newest_of": kind}
        inbox.post(lambda word=word: ran.append(word), **name)  # type: ignore[misc]
    drain(inbox)
    assert (" ".join(ran), inbox.dropped) == (runs, dropped)


def test_internal_jobs_are_first_in_line_and_never_dropped() -> None:
    inbox, ran = Inbox(limit=1), list[str]()
    inbox.post(lambda: ran.append("job"))
    for _ in range(3):
        inbox.post_internal(lambda: ran.append("internal"))
    drain(inbox)
    assert (ran, inbox.dropped) == ([*["internal"] * 3, "job"], 0)


def test_take_waits_for_a_job_and_gives_up_after_its_timeout_or_when_it_is_woken() -> None:
    inbox, ran = Inbox(), list[str]()
    for post in (inbox.post, inbox.post_internal):
        threading.Timer(0.05, post, [lambda: ran.append("job")]).start()
        job = inbox.take(None)
        assert job is not None
        job()
    assert ran == ["job", "job"]
    assert inbox.take(0.01) is None
    threading.Timer(0.05, inbox.wake).start()
    assert inbox.take(None) is None
    assert inbox.take(0.01) is None, "it was woken once"


def test_a_timeout_that_ends_while_it_is_looked_at_is_no_wait_for_ever() -> None:
    """queue.SimpleQueue would hang here within a second."""
    inbox, done = Inbox(), threading.Event()

    def work() -> None:
        for number in range(cases(4_000, 30_000)):
            inbox.take(1e-6)
            inbox.post(lambda: None)
            inbox.take(None)
            inbox.take(number % 60 / 1e7)
        done.set()

    threading.Thread(target=work, daemon=True).start()
    assert done.wait(60)


def test_a_signal_handler_may_post_while_its_own_thread_waits_or_posts() -> None:
    inbox, taken = Inbox(), 0
    before = signal.signal(signal.SIGALRM, lambda *_: inbox.post_internal(lambda: None))
    signal.setitimer(signal.ITIMER_REAL, 0.001, 0.001)
    try:
        end = time.monotonic() + 20
        while taken < 300 and time.monotonic() < end:
            inbox.post(lambda: None, newest_of="one")
            taken += inbox.take(0.002) is not None
            taken += inbox.take(None) is not None
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert taken >= 300


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
        if len(ran) == 4:
            timer.cancel()

    timer = timers.add(1.0, tick, period=1.0)
    timers.run_due(1.25)
    assert timers.wait(1.25) == 0.75, "lateness does not add up"
    timers.run_due(2.0)
    timers.run_due(5.5)
    assert (ran, timers.wait(5.5)) == ([0, 1, 2], 1.0), "missed turns are skipped"
    timers.run_due(6.5)
    assert (ran, timers.wait(6.5)) == ([0, 1, 2, 3], None)


def test_no_other_thread_enters_before_the_own_one_that_waits() -> None:
    lock, ends = WorkLock(), threading.Event()

    def work() -> None:
        with lock:
            ends.wait(WAIT_S)

    assert lock.try_enter()
    own = threading.Thread(target=work, daemon=True)
    own.start()
    assert until(lambda: lock.awaited)
    lock.leave()
    try:
        assert not any(lock.try_enter() for _ in range(1000))
    finally:
        ends.set()
        own.join(WAIT_S)
    assert lock.try_enter()


def test_a_lock_that_is_shut_is_never_entered() -> None:
    lock = WorkLock()
    lock.shut()
    assert not lock.try_enter()
