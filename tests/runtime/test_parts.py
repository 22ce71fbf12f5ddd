"""What the thread of a service waits for (inbox, timers, lock), and what it makes of streams and of sources."""

from __future__ import annotations

import logging
import os
import random
import re
import signal
import subprocess
import sys
import threading
import time
from math import inf

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pebble.runtime.bounded_output import KEPT, BoundedOutput
from pebble.runtime.inbox import Inbox
from pebble.runtime.lines import LineSplitter
from pebble.runtime.rate_limit import RateLimitedLog
from pebble.runtime.source_check import SourceCheck
from pebble.runtime.timers import Timers
from pebble.runtime.work_lock import WorkLock
from pebble.services.serial_mcu_bridge.moving_sensors import MovingSensors
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


def test_the_next_timer_is_the_first_that_is_not_cancelled() -> None:
    timers = Timers()
    assert timers.next_due == inf
    first = timers.add(5.0, lambda: None)
    timers.add(7.0, lambda: None)
    assert timers.next_due == 5.0
    first.cancel()
    assert timers.next_due == 7.0


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
    assert timers.next_due == 2.0, "lateness does not add up"
    timers.run_due(2.0)
    timers.run_due(5.5)
    assert (ran, timers.next_due) == ([0, 1, 2], 6.5), "missed turns are skipped"
    timers.run_due(6.5)
    assert (ran, timers.next_due) == ([0, 1, 2, 3], inf)


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
    lock, left = WorkLock(), threading.Event()
    assert lock.try_enter()
    threading.Timer(0.05, lambda: (left.set(), lock.leave())).start()
    lock.shut()
    assert left.is_set(), "it waits for the thread that works"
    assert not lock.try_enter()


def test_no_log_line_waits_for_a_launcher_that_stands_still() -> None:
    program = "import logging, pebble.runtime.parent as p; p.set_up_logging('INFO')\n"
    program += "for _ in range(200): logging.error('x' * 1000)"
    read_end, write_end = os.pipe()
    try:
        assert subprocess.run([sys.executable, "-c", program], stderr=write_end, timeout=WAIT_S).returncode == 0
    finally:
        os.close(read_end)
        os.close(write_end)


def test_a_subject_of_a_log_makes_room_once_its_period_is_over() -> None:
    log = RateLimitedLog(logging.getLogger("limited"), period_s=0.01, most=1)
    for subject in ("old", "new"):
        log.warning(subject, "an event")
        time.sleep(0.02)
    assert log.totals() == {"new": 1}


# -- a stream becomes lines: bounded in length and number, none left out unmentioned


@given(st.lists(st.binary(max_size=20).filter(lambda line: b"\n" not in line)), st.randoms(use_true_random=False))
def test_lines_come_out_however_the_stream_is_cut(lines: list[bytes], cuts: random.Random) -> None:
    stream = b"".join(line + b"\n" for line in lines)
    splitter, out = LineSplitter(20), list[bytes]()
    while stream:
        size = cuts.randint(1, 30)
        out += splitter.feed(stream[:size])
        stream = stream[size:]
    assert out == lines
    assert splitter.discarded_lines == 0


def test_half_a_line_is_the_rest_and_is_forgotten_by_a_reset() -> None:
    splitter = LineSplitter()
    assert splitter.feed(b"one\ntw") == [b"one"]
    assert (splitter.rest(), splitter.rest()) == (b"tw", b"")
    splitter.feed(b"C chg=1 v=")
    splitter.reset()
    assert splitter.feed(b"7.4\n") == [b"7.4"]


#: Whether long lines are truncated, what is fed to a splitter of 10 bytes, its lines, and how many it has discarded.
STREAMS: dict[str, tuple[bool, list[bytes], list[bytes], int]] = {
    "in pieces": (False, [b"one\ntw", b"o\r\n\n  three  \n"], [b"one", b"two\r", b"", b"  three  "], 0),
    "exactly the limit": (True, [b"x" * 10, b"\nnext\n"], [b"x" * 10, b"next"], 0),
    "without end": (False, [b"good\n" + b"x" * 8, *[b"x" * 8] * 1000, b"end\nnext\n"], [b"good", b"next"], 1),
    "too long within a chunk": (False, [b"a\n" + b"x" * 11 + b"\nb\n"], [b"a", b"b"], 1),
    "without end, truncated": (True, [*[b"x" * 7] * 100, b"xx\nnext\n"], [b"x" * 10, b"next"], 1),
    "too long within a chunk, truncated": (True, [b"y" * 20 + b"\nnext\n"], [b"y" * 10, b"next"], 1),
}


@pytest.mark.parametrize(("truncate", "chunks", "lines", "discarded"), STREAMS.values(), ids=STREAMS)
def test_long_lines_cost_no_memory(truncate: bool, chunks: list[bytes], lines: list[bytes], discarded: int) -> None:
    splitter = LineSplitter(10, truncate=truncate)
    assert [line for chunk in chunks for line in splitter.feed(chunk)] == lines
    assert splitter.discarded_lines == discarded


LONGEST, RATE = 3500, 10.0  # 20 at once


class Log(BoundedOutput):
    def __init__(self) -> None:
        self.lines: list[bytes] = []
        self.said: list[str] = []
        super().__init__(self._take, LONGEST, 0.0, rate=RATE)

    def _take(self, line: bytes) -> None:
        own = re.fullmatch(rb"\d\d:\d\d:\d\d \[(WARNING|INFO)\] (.*)", line)
        if own:
            self.said.append(own[2].decode())
        else:
            self.lines.append(line)


@pytest.fixture
def log() -> Log:
    return Log()


def numbers(count: int, begin: int = 0) -> bytes:
    return b"".join(b"line %d\n" % number for number in range(begin, begin + count))


def test_chunks_become_lines_and_long_ones_are_cut(log: Log) -> None:
    for chunk in (b"one\r\ntw", b"o\n\n  \nth", b"ree\n", b"x" * 1_000_000 + b"\nnext"):
        log.feed(chunk, 0.0)
    log.end()
    assert log.lines == [b"one", b"two", b"three", b"x" * LONGEST, b"next"]
    assert log.said == []


def test_a_flood_is_cut_and_counted_and_its_last_words_are_kept(log: Log) -> None:
    log.feed(numbers(500), 0.1)
    assert (len(log.lines), log.flooded, log.said) == (20, True, [])
    log.feed(numbers(9_500, 500), 0.2)  # of which most is counted only
    log.tick(0.5)
    assert log.said == []
    log.tick(1.2)
    assert log.said == [f"{10_000 - 20 - KEPT} lines are left out: 10 a second are logged"]
    assert log.lines[-2:] == [b"line 9998", b"line 9999"]
    log.feed(b"after\n", 3.0)
    assert (log.lines[-1], log.flooded, log.waits) == (b"after", False, False)


@pytest.mark.parametrize("at", [0.2, 7.0], ids=["at once", "after a report of a flood that goes on"])
def test_the_last_words_of_a_program_that_ends_are_kept(log: Log, at: float) -> None:
    log.feed(numbers(100), 0.1)
    log.feed(numbers(900, 100), at)
    log.tick(at + 0.1)
    log.feed(b"fatal: no encoder", at + 0.1)
    log.end()
    assert log.lines[-1] == b"fatal: no encoder"
    missing = sum(int(said.split()[0]) for said in log.said)
    assert missing + len(log.lines) == 1_001


def test_repeated_lines_are_one_line_and_a_number_whatever_their_clocks_say(log: Log) -> None:
    log.feed(b"10:00:00 [ERROR] slow\n10:00:00 [ERROR] slow\n10:00:01 [ERROR] slow\nother\n", 0.0)
    log.feed(b"other\n", 2.0)  # no repetition after so long
    assert log.lines == [b"10:00:00 [ERROR] slow", b"other", b"other"]
    assert log.said == ["the line before came 2 more times"]


# -- a source that repeats itself, or comes at another rate than asked


#: Contents, ten in a second, each letter for a second: how many repeat in the end.
CONTENTS = {
    "each differs": ("?" * 10, False),
    "the same": ("a" * 7, True),
    "it moved again": ("aaaaaaaab", False),
    "while it need not change": ("AAAAAAAAA", False),
    "at rest, then not long": ("AAAAAAAAAaaaa", False),
    "between rests": ("aaAAaaAAaaA", True),
}


@pytest.mark.parametrize(("seconds", "repeats"), CONTENTS.values(), ids=CONTENTS)
def test_contents(seconds: str, repeats: bool) -> None:
    check = SourceCheck()
    for number in range(10 * len(seconds)):
        letter = seconds[number // 10]
        content = number if letter == "?" else letter.lower()
        check.take(content, number / 10, counts=not letter.isupper())
    assert check.repeats is repeats


#: Values of three sensors, each letter for a second at 50 Hz: x changes, others stay; and who is found.
SENSORS = {
    "at rest": (["aaaaaaaaaa", "bbbbbbbbbb", "cccccccccc"], ".........", ""),
    "all still while driven": (["aaaaaaaaaa", "bbbbbbbbbb", "cccccccccc"], "dddddddddd", "left, right, third repeat"),
    "one of them stops": (["xxaaaaaaaaa", "xxxxxxxxxxx", "xxxxxxxxxxx"], "ddddddddddd", "left repeats its value"),
    "driven in short moves": (
        ["aaaaaaaaaaaaa", "bbbbbbbbbbbbb", "ccccccccccccc"],
        "dd.dd.dd.dd.dd",
        "left, right, third",
    ),
}


@pytest.mark.parametrize(("values", "drives", "found"), SENSORS.values(), ids=SENSORS)
def test_sensors_change_while_the_wheels_turn(values: list[str], drives: str, found: str) -> None:
    sensors = MovingSensors()
    for number in range(50 * len(values[0])):
        second, now = number // 50, number / 50
        sensors.drive(now + 0.75 if drives[second : second + 1] == "d" else 0.0)
        letters = zip(("left", "right", "third"), (each[second] for each in values), strict=True)
        sensors.take({name: number if letter == "x" else letter for name, letter in letters}, now)
    assert sensors.problem.startswith(found)
    assert bool(sensors.problem) is bool(found)
