"""Counts are exact, whichever threads count and look meanwhile."""

from __future__ import annotations

import threading

from pebble.transports.counters import Counters


def test_what_threads_count_while_others_look_is_exact() -> None:
    counters, one = Counters(), 5000
    add, ended = counters.adder("sent"), threading.Event()

    def count() -> None:
        for _ in range(one):
            add()
            counters.add("sent", 2)

    def look() -> None:
        seen = 0
        while not ended.is_set():
            found = counters["sent"]
            assert found >= seen
            seen = found
            counters.snapshot()

    counting, looking = ([threading.Thread(target=act) for _ in range(4)] for act in (count, look))
    for thread in counting + looking:
        thread.start()
    for thread in counting:
        thread.join()
    ended.set()
    for thread in looking:
        thread.join()
    assert counters["sent"] == counters.snapshot()["sent"] == 4 * 3 * one
