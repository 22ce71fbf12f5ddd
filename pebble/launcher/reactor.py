"""An event loop of one thread: it waits for descriptors, timers and stop signals at once."""

import selectors
import signal
import time
from collections.abc import Callable
from math import inf
from types import FrameType

from pebble.runtime.signals import ending_signals
from pebble.runtime.timers import Timer, Timers
from pebble.transports.wakeup import WakeupPipe

_TURN_S = 1.0  # the longest wait of one turn
_STALL_S = 2.0  # a turn that takes this much longer: the process was frozen, as a suspended machine's, or starved

Job = Callable[[], None]


class Reactor:
    """A loop that calls jobs when a descriptor can be read or a time has come. For one thread only.

    Its clock does not count time in which this process is suspended, because the other processes are then mostly
    suspended, too. ``on_stall(seconds)`` is called afterwards.
    """

    def __init__(
        self, clock: Callable[[], float] = time.monotonic, *, on_stall: Callable[[float], None] = lambda _seconds: None
    ) -> None:
        self._selector = selectors.DefaultSelector()
        self._timers = Timers()
        self._clock, self._on_stall = clock, on_stall
        self._stood_still_s = 0.0  # the sum of all stalls, which this clock leaves out
        self._read_at: float | None = None  # when the clock was last read; None while nothing runs

    def now(self) -> float:
        """Return the time by this reactor's clock, in seconds; note a stall since the last call."""
        now = self._clock()
        if self._read_at is not None:
            before, self._read_at = self._read_at, now
            passed_s = now - before
            if passed_s > _TURN_S + _STALL_S:
                self._stood_still_s += passed_s - _TURN_S  # the clock goes on by a turn: else no timer might come due
                self._on_stall(passed_s)
        return now - self._stood_still_s

    def watch(self, descriptor: int, job: Job) -> None:
        """Call ``job`` whenever ``descriptor`` has something to read, until :meth:`forget`."""
        self._selector.register(descriptor, selectors.EVENT_READ, job)

    def forget(self, descriptor: int) -> None:
        self._selector.unregister(descriptor)

    def at(self, due: float, job: Job) -> Timer:
        """Call ``job`` at the time ``due`` of :meth:`now`."""
        return self._timers.add(due, job)

    def after(self, seconds: float, job: Job) -> Timer:
        return self._timers.add(self.now() + seconds, job)

    def every(self, seconds: float, job: Job) -> Timer:
        return self._timers.add(self.now() + seconds, job, period=seconds)

    def run_until(self, condition: Callable[[], bool], timeout: float | None = None) -> bool:
        """Run jobs until ``condition()`` is true; return False if ``timeout`` seconds pass first."""
        end = None if timeout is None else self.now() + timeout
        self._read_at = self._clock()  # what passed before is no stall
        try:
            while not condition():
                now = self.now()
                if end is not None and now >= end:
                    return False
                self._turn(min(self._timers.next_due, inf if end is None else end) - now)
            return True
        finally:
            self._read_at = None

    def close(self) -> None:
        self._selector.close()

    def _turn(self, wait_s: float) -> None:
        """Run the jobs of readable descriptors, then timers: a timer that checks for life needs the newest signs."""
        for key, _ in self._selector.select(max(0.0, min(_TURN_S, wait_s))):
            if key.fd in self._selector.get_map():  # an earlier job of this turn may have forgotten it
                key.data()
        self._timers.run_due(self.now())


class StopSignals:
    """A counter of SIGTERM, SIGINT and SIGHUP from :meth:`install` on; each sets ``wakeup``.

    From the second signal on, the handler calls ``on_repeat``, as the user no longer wants to wait. Main thread only.
    """

    def __init__(self, on_repeat: Callable[[], None]) -> None:
        self.received = 0
        self._on_repeat = on_repeat
        self.wakeup = WakeupPipe()

    def install(self) -> None:
        """Handle the signals until the process ends, except ignored ones (nohup)."""
        signal.set_wakeup_fd(self.wakeup.set_fileno, warn_on_full_buffer=False)
        for number in ending_signals():
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._receive)

    def _receive(self, _number: int, _frame: FrameType | None) -> None:
        self.received += 1
        if self.received > 1:
            self._on_repeat()
