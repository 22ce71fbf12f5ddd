from __future__ import annotations

import threading

from pebble.inbox import Inbox
from tests.support import until


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
    assert inbox._wakes.qsize() == 0, "as many wake-ups as jobs: the one is bounded if the other is"


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


def test_take_gives_up_after_its_timeout() -> None:
    assert Inbox().take(0.01) is None
