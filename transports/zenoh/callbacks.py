"""Makes Zenoh callbacks by ``direct(f)``: they run on the thread that receives, which is the fastest way.

Two problems of these threads, which are Rust's, are solved here.

1. Python's state. For each callback Python makes a state for such a thread, and frees it afterwards, which takes 5 % of
a message's cost (Python 3.11). A state that is requested once more than it is released (PyGILState_Ensure of Python's C
API) stays, also when its thread ends: some 17 KB. Zenoh seldom makes a new thread (forty sessions, one after the other:
five). Even so, only the first threads keep their state.

2. Blocking. One of these threads at a time waits for all sockets. It runs the callbacks itself, and meanwhile no other
thread waits for the sockets unless it is given something to do. So a callback that waits for room would wait until
Zenoh closes that connection, because no thread notices that there is room again. Where a callback takes long, a guard
gives another of Zenoh's threads something to do. Measured with 1.10.2: of 2,000 messages of 1 KB that a callback
publishes 1,000 are lost without the guard, and none with it.
"""

from __future__ import annotations

import ctypes
import logging
import threading
import time
from collections.abc import Callable
from typing import Any

import zenoh

from pebble.transports.wakeup import Wakeup

log = logging.getLogger(__name__)

MOST = 32  # threads of a process that are looked after
_LOOK_S = 0.1  # between two looks for a callback that runs
_AGAIN_S = 0.02  # the same after one was found; if it still runs, it takes long
_REST = 5  # looks without a new callback, after which the guard sleeps until the next one
_HELP_S = 0.005  # the time limit of the query that gives another thread something to do
_NOTHING = "@pebble/nothing"  # a key

ensure_state = ctypes.pythonapi.PyGILState_Ensure


class Calls:
    """Counters of one thread: callbacks begun and ended, and what the guard saw when it looked last."""

    __slots__ = ("begun", "begun_before", "ended", "ran")

    def __init__(self) -> None:
        self.begun = self.ended = 0
        self.begun_before = 0  # `begun` when the guard looked last
        self.ran = False  # a callback was running then


class Guard:
    """A watch for callbacks that take long: it makes another of Zenoh's threads wait for the sockets instead."""

    def __init__(self) -> None:
        self.rests = True  # it sleeps until a callback wakes it
        self.helped = 0  # times
        self._suspects = False  # it found a running callback when it looked last
        self._warned = False
        self._wakeup, self._lock = Wakeup(), threading.Lock()
        self._thread: threading.Thread | None = None
        self._calls: list[Calls] = []  # of the threads that run callbacks
        self._sessions: list[zenoh.Session] = []  # by which threads are given something to do

    def use(self, session: zenoh.Session) -> None:
        """Remember a session, through which a thread can be given work. Any session does: all share Zenoh's threads."""
        with self._lock:
            self._sessions.append(session)

    def forget(self, session: zenoh.Session) -> None:
        """Forget a session before it is closed: a reference would keep its memory and files."""
        with self._lock:
            self._sessions = [other for other in self._sessions if other is not session]

    def watch(self, calls: Calls) -> bool:
        """Watch a thread's callbacks; False if there are too many threads."""
        with self._lock:
            if len(self._calls) >= MOST:
                return False
            self._calls.append(calls)
            return True

    def wake(self) -> None:
        with self._lock:
            if self._thread is None:
                thread = threading.Thread(target=self._run, name="pebble-guard", daemon=True)
                try:
                    thread.start()
                except RuntimeError as error:  # too many threads: the next callback tries again
                    if not self._warned:
                        log.warning("no guard for handlers that wait: %s", error)
                    self._warned = True
                    return
                self._thread = thread
            self.rests = False
            self._wakeup.set()

    def _run(self) -> None:
        quiet = 0
        while True:
            time.sleep(_AGAIN_S if self._suspects else _LOOK_S)
            quiet = 0 if self._look() else quiet + 1
            if quiet < _REST:
                continue
            self.rests = True
            if not self._look():  # else a callback has begun before `rests` was set, and woke no guard
                self._wakeup.wait(None)
            self.rests, quiet = False, 0

    def _look(self) -> bool:
        """Help if a callback takes long; return True if any has begun since the last look, or still runs."""
        active = self._suspects = False
        for calls in self._calls:
            begun, runs = calls.begun, calls.begun != calls.ended
            active = active or runs or begun != calls.begun_before
            if runs and calls.ran:  # at both looks: one that takes long, or many without a pause
                self._help()
            self._suspects = self._suspects or runs  # then `_run` looks again soon
            calls.begun_before, calls.ran = begun, runs
        return active

    def _help(self) -> None:
        """Give another of Zenoh's threads something to do: the task that Zenoh starts for a query's time limit."""
        self.helped += 1
        with self._lock:
            sessions = self._sessions[::-1]  # a copy, the newest first
        for session in sessions:  # one that works is enough: all share Zenoh's threads
            try:  # the query does not leave the session
                session.get(_NOTHING, _nothing, timeout=_HELP_S, allowed_destination=zenoh.Locality.SESSION_LOCAL)
            except Exception:  # closed meanwhile; whatever it is, the guard goes on
                log.debug("no help from a session", exc_info=True)
            else:
                return


guard = Guard()
_nothing: zenoh.handlers.Callback[Any] = zenoh.handlers.Callback(lambda _reply: None, indirect=False)
_local = threading.local()  # part of a thread's state: empty in a new thread
use, forget = guard.use, guard.forget


def _begin() -> Calls:
    """Note the first callback on this thread; return the thread's counters."""
    calls = _local.calls = Calls()
    # A thread of Python's has its state, and waits for no sockets: it publishes to a handler of its own session.
    if isinstance(threading.current_thread(), threading._DummyThread) and guard.watch(calls):
        ensure_state()
    return calls


def direct(function: Callable[[Any], None], at_end: Callable[[], None] | None = None) -> zenoh.handlers.Callback[Any]:
    """Return a callback that runs on Zenoh's receiving thread. By default Zenoh queues, and may then block that thread.

    ``at_end`` is called when no more calls can come.
    """

    def run(received: Any) -> None:
        calls = _local.calls if hasattr(_local, "calls") else _begin()
        calls.begun += 1  # until `ended` is as great, the guard sees a callback that runs
        try:
            if guard.rests:
                guard.wake()
            function(received)
        finally:
            calls.ended += 1

    return zenoh.handlers.Callback(run, at_end, indirect=False)
