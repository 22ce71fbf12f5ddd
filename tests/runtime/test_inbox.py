from __future__ import annotations

import signal
import threading
import time

import pytest

from pebble.runtime.inbox import Inbox
from tests.support import cases


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
    for _ in range(5):
        inbox.post_internal(lambda: ran.append("internal"))
    drain(inbox)
    assert ran == [*["internal"] * 5, "job"]
    assert inbox.dropped == 0


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
        for number in range(cases(8_000, 30_000)):
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
