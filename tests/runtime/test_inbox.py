from __future__ import annotations

import signal
import threading
import time

import pytest

from pebble.runtime.inbox import Inbox
from tests.support import cases, until


def drain(inbox: Inbox) -> None:
    while (job := inbox.take(0)) is not None:
        job()


def test_jobs_come_out_in_the_order_they_came_in() -> None:
    inbox, ran = Inbox(), list[int]()
    for number in range(5):
        inbox.post(lambda number=number: ran.append(number))  # type: ignore[misc]
    drain(inbox)
    assert ran == [0, 1, 2, 3, 4]
    assert inbox.take(0) is None


def test_the_newest_of_a_kind_takes_the_place_of_the_one_that_waits() -> None:
    inbox, ran = Inbox(), list[str]()
    inbox.post(lambda: ran.append("drive 1"), newest_of="drive")
    inbox.post(lambda: ran.append("lights"))
    inbox.post(lambda: ran.append("drive 2"), newest_of="drive")
    drain(inbox)
    assert ran == ["drive 2", "lights"]
    assert inbox.dropped == 0, "it was replaced, not lost"


def test_beyond_the_limit_the_oldest_is_dropped_and_counted() -> None:
    inbox, ran = Inbox(limit=3), list[int]()
    for number in range(10):
        inbox.post(lambda number=number: ran.append(number))  # type: ignore[misc]
    inbox.post(lambda: ran.append(100), newest_of="drive")
    inbox.post(lambda: ran.append(101), newest_of="drive")
    drain(inbox)
    assert ran == [8, 9, 101]
    assert inbox.dropped == 8


@pytest.mark.parametrize(
    ("posts", "expected"),
    [
        (["STOP", 0, 1, 2, 3, 4], ["STOP", 3, 4]),
        ([0, "STOP", 1, "STOP", 2], [1, "STOP", 2]),
        (["drive", "STOP", 0, 1, 2], ["drive", "STOP", 2]),
        (["STOP", 0, 1, "STOP"], [0, 1, "STOP"]),
        (["A", "B", "C", "D"], ["B", "C", "D"]),
    ],
)
def test_what_ends_something_is_not_dropped_for_others_and_comes_after_what_it_ends(
    posts: list[str | int], expected: list[str | int]
) -> None:
    inbox, ran = Inbox(limit=3), list[str | int]()
    for one in posts:
        name = {} if isinstance(one, int) else {"last_of" if one.isupper() else "newest_of": one}
        inbox.post(lambda one=one: ran.append(one), **name)  # type: ignore[misc]
    drain(inbox)
    assert ran == expected


def test_internal_jobs_are_first_in_line_and_never_dropped() -> None:
    inbox, ran = Inbox(limit=1), list[str]()
    inbox.post(lambda: ran.append("job"))
    for _ in range(5):
        inbox.post_internal(lambda: ran.append("internal"))
    drain(inbox)
    assert ran == [*["internal"] * 5, "job"]
    assert inbox.dropped == 0


def test_a_waiting_thread_is_woken() -> None:
    inbox, ran = Inbox(), list[str]()

    def work() -> None:
        for _ in range(2):
            job = inbox.take(None)
            assert job is not None
            job()

    thread = threading.Thread(target=work)
    thread.start()
    inbox.post(lambda: ran.append("job"))
    assert until(lambda: ran == ["job"])
    inbox.post_internal(lambda: ran.append("internal"))
    thread.join(10)
    assert ran == ["job", "internal"]


def test_take_gives_up_after_its_timeout_or_when_it_is_woken() -> None:
    inbox = Inbox()
    assert inbox.take(0.01) is None
    inbox.wake()
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
