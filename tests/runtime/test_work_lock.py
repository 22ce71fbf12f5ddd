from __future__ import annotations

import threading

from pebble.runtime.work_lock import WorkLock
from tests.support import until


def test_no_other_thread_enters_before_the_own_one_that_waits() -> None:
    lock, ends = WorkLock(), threading.Event()

    def work() -> None:
        with lock:
            ends.wait(10)

    assert lock.try_enter()
    own = threading.Thread(target=work, daemon=True)
    own.start()
    assert until(lambda: lock.awaited)
    lock.leave()
    try:
        assert not any(lock.try_enter() for _ in range(1000))
    finally:
        ends.set()
        own.join(10)
    assert lock.try_enter()


def test_a_lock_that_is_shut_is_never_entered() -> None:
    lock = WorkLock()
    lock.shut()
    assert not lock.try_enter()
