"""The history of one program's starts and exits: when to start it again, and when it counts as stuck. Pure."""

from collections import deque
from typing import Literal

ReportedState = Literal["init", "ready", "restarting", "failed", "stopped"]

STABLE_S = 60.0  # a process that ran this long has earned a clean record
LOOP_EXITS, LOOP_WINDOW_S = 5, 60.0  # this many exits within this time are a crash loop
LOOP_RETRY_S = 10.0  # at least this long between attempts in a crash loop: its cause may go away by itself
START_LIMIT_S = 30.0  # from start to the first sign of life
ALIVE_LIMIT_S = 10.0  # between signs of life; services give one every second
START_INTERVAL_S = 1.0  # between two starts of an on-demand program: a start costs half a second of CPU


class RestartPolicy:
    """The decisions about one program by the times of its starts, signs of life and exits. Times are passed in.

    ``restart_delay_s`` (services.launcher.restart_delay_seconds) scales the waits: the first restart is immediate,
    the second waits a quarter of it, and each further one twice as long, up to five times ``restart_delay_s``.
    With the default of 2 s: 0, 0.5, 1, 2, 4, 8, 10, 10 … seconds.
    """

    def __init__(self, restart_delay_s: float = 2.0) -> None:
        self.state: ReportedState = "init"  # as the robot's status shows it
        self.restarts = 0
        self.last_exit: str | None = None
        self.first_attempt_done = False  # has been ready or has ended at least once
        #: When, without a further sign of life, the process counts as stuck.
        self.stuck_at = float("inf")
        self._delay_s = restart_delay_s
        self._exits: deque[float] = deque(maxlen=LOOP_EXITS)  # when it ended unexpectedly: is it a crash loop?
        self._exits_in_a_row = 0  # unexpected ones, by which the wait grows; from 1 again after STABLE_S of running
        self._started = float("-inf")

    @property
    def in_crash_loop(self) -> bool:
        """True if the last exits came so fast that a program is restarted only after a long wait."""
        return len(self._exits) == LOOP_EXITS and self._exits[-1] - self._exits[0] <= LOOP_WINDOW_S

    def exits_within_a_minute(self, now: float) -> int:
        """Return the number of unexpected exits in the last minute, LOOP_EXITS at most."""
        return len([exited_at for exited_at in self._exits if now - exited_at <= LOOP_WINDOW_S])

    def request_delay_s(self, now: float) -> float:
        """Return the seconds to wait before an on-demand program is started again by a new request."""
        return max(0.0, self._started + START_INTERVAL_S - now)

    def started(self, now: float, *, plain: bool = False) -> None:
        """Record a start. A ``plain`` program need not report anything: it counts as ready, and not as stuck."""
        if self.state == "stopped":  # it was asked to end: this is no restart
            self.state = "init"
        elif self.last_exit is not None:
            self.restarts += 1
        self._started = now
        self.stuck_at = now + START_LIMIT_S
        if plain:
            self.ready(now)
            self.stuck_at = float("inf")  # unless a sign of life comes after all: then more are expected

    def ready(self, now: float) -> None:
        self.state = "ready"
        self.first_attempt_done = True
        self.alive(now)

    def alive(self, now: float) -> None:
        self.stuck_at = now + ALIVE_LIMIT_S

    def exited(self, now: float, how: str) -> float:
        """Record an unexpected exit; return the seconds to wait before the next start."""
        self._ended(how)
        if now - self._started >= STABLE_S:
            self._exits.clear()
            self._exits_in_a_row = 0
        self._exits.append(now)
        self._exits_in_a_row += 1
        if self.in_crash_loop:
            self.state = "failed"
            return max(LOOP_RETRY_S, 5 * self._delay_s)
        self.state = "restarting"
        return self._wait_s()

    def stopped(self, how: str | None) -> None:
        """Record a requested exit; ``how`` is None if no process was running."""
        self._ended(self.last_exit if how is None else how)
        self.state = "stopped"

    def _ended(self, how: str | None) -> None:
        self.last_exit = how
        self.first_attempt_done = True
        self.stuck_at = float("inf")

    def _wait_s(self) -> float:
        if self._exits_in_a_row == 1:
            return 0.0
        doublings = min(self._exits_in_a_row - 2, 8)  # far beyond the limit, and no overflow after a thousand exits
        return min(self._delay_s / 4 * 2.0**doublings, 5 * self._delay_s)
