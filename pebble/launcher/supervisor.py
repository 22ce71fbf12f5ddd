"""What becomes of one child process: its state, when to start it again, and when it counts as stuck. Pure."""

from __future__ import annotations

from collections import deque
from typing import Literal

LifeState = Literal["init", "ready", "restarting", "failed", "stopped"]

STABLE_S = 60.0  # a child that ran this long has earned a clean record
LOOP_EXITS, LOOP_WINDOW_S = 5, 60.0  # this many exits within this time are a crash loop
LOOP_RETRY_S = 10.0  # at least this long between attempts in a crash loop: it may heal by itself
START_LIMIT_S = 30.0  # from start to the first sign of life
ALIVE_LIMIT_S = 10.0  # between signs of life; services give one every second
REST_S = 1.0  # between two starts of a program that is wanted, unwanted, wanted, …: a start costs half a second of CPU


class Life:
    """The record of one child, across its restarts. Clock values are passed in; nothing here touches a process.

    ``restart_delay_s`` (services.launcher.restart_delay_seconds) scales the waits: the first restart is immediate,
    the second waits a quarter of it, and each further one twice as long, up to five times ``restart_delay_s``.
    With the default of 2 s: 0, 0.5, 1, 2, 4, 8, 10, 10 … seconds.
    """

    def __init__(self, restart_delay_s: float = 2.0) -> None:
        self.state: LifeState = "init"
        self.restarts = 0
        self.last_exit: str | None = None
        self.settled = False  # has been ready or has ended at least once
        #: When, without a further sign of life, the child counts as stuck.
        self.stuck_at = float("inf")
        self._delay_s = restart_delay_s
        self._exits: deque[float] = deque(maxlen=LOOP_EXITS)
        self._in_a_row = 0
        self._started = float("-inf")

    @property
    def looping(self) -> bool:
        """Does it end again and again, faster than starting it could be worth?"""
        return len(self._exits) == LOOP_EXITS and self._exits[-1] - self._exits[0] <= LOOP_WINDOW_S

    def rest_s(self, now: float) -> float:
        """How many seconds to wait before a program that was stopped is started because it is wanted again."""
        return max(0.0, self._started + REST_S - now)

    def started(self, now: float) -> None:
        if self.state == "stopped":  # that was asked for: no restart
            self.state = "init"
        elif self.last_exit is not None:
            self.restarts += 1
        self._started = now
        self.stuck_at = now + START_LIMIT_S

    def ready(self, now: float) -> None:
        self.state = "ready"
        self.settled = True
        self.alive(now)

    def alive(self, now: float) -> None:
        self.stuck_at = now + ALIVE_LIMIT_S

    def exited(self, now: float, how: str) -> float:
        """Record an unexpected end; returns how many seconds to wait before the next start."""
        self._ended(how)
        if now - self._started >= STABLE_S:
            self._exits.clear()
            self._in_a_row = 0
        self._exits.append(now)
        self._in_a_row += 1
        if self.looping:
            self.state = "failed"
            return max(LOOP_RETRY_S, 5 * self._delay_s)
        self.state = "restarting"
        return self._wait_s()

    def stopped(self, how: str | None) -> None:
        """Record an end that was asked for, or that no child was running when it was."""
        self._ended(self.last_exit if how is None else how)
        self.state = "stopped"

    def _ended(self, how: str | None) -> None:
        self.last_exit = how
        self.settled = True
        self.stuck_at = float("inf")

    def _wait_s(self) -> float:
        if self._in_a_row == 1:
            return 0.0
        doublings = min(self._in_a_row - 2, 8)  # far beyond the limit, and no overflow after a thousand exits
        return min(self._delay_s / 4 * 2.0**doublings, 5 * self._delay_s)
