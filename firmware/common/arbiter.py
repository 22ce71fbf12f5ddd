"""The arbiter of drive commands: none while latched, the holder of control, people before scripts. Pure.

Boards and Linux robots share it.

A drive command with all axes 0 is a zero. A person's zero is never refused. Commands of a script carry the number of
its run, which grows with each start; a run that is barred never moves anything again. The numbers have no end: after
LAST_RUN comes 1, so whatever number a stranger sends, there is a newer one.
"""

# So long after a person's last command scripts are refused; and after the start, so that the script manager first
# sees that the motor owner has restarted.
HOLD_MS = 2000

LAST_RUN = (1 << 30) - 1  # the largest integer for which MicroPython allocates no memory on a 32-bit board

PERSON = 0  # in place of the number of a run
UNKNOWN_RUN = -1  # a script's zero without a valid number
REFUSED = -1


def newer(run: int, last: int) -> bool:
    """True if ``run`` began after ``last``: it is ahead by less than half of all numbers. 0 and less are no runs."""
    return run > 0 and (last == 0 or 0 < (run - last) & LAST_RUN < 1 << 29)


class Arbiter:
    """An arbiter: ``judge`` every drive command, ``stop`` at every emergency stop, ``tick`` regularly."""

    def __init__(self, latch, lease, now: int, diff, watchdog_ms: int) -> None:
        """Store the arguments; a command moves anything for ``watchdog_ms`` at most. See latch.py for ``diff``."""
        self.latch = latch
        self.lease = lease
        self.barred = 0  # runs up to this number
        self._diff = diff
        self._watchdog_ms = watchdog_ms
        self._newest = 0  # the newest run received; all before it are barred
        self._starting = True  # scripts are refused for HOLD_MS, see there
        self._started = now
        self._held = False  # scripts wait: a person commanded less than HOLD_MS ago
        self._held_from = now
        self._resumes = True  # scripts go on after that: the person's last command was a zero, not final (see _take)
        self._scripted = False  # the newest admitted command is a script's, and within its deadline
        self._script_from = now
        self._script_ms = 0

    def judge(self, moves: bool, run: int, valid_ms: float, now: int, key: str = "", by: str | None = "") -> int:
        """Return for how many milliseconds the command moves the motors; 0: it stops them, REFUSED: it has no effect.

        ``moves``: any axis is not 0. ``run`` may be PERSON, or UNKNOWN_RUN for a zero. ``valid_ms`` < 0: not given.
        ``key`` and ``by`` are as in the lease; ``by`` None: a program of the robot, which needs no key. Where names are
        not checked, scripts need no key either. A zero of a client without control ends a script, also a waiting one,
        but it is not the zero for which the latch waits after a reset.
        """
        self.tick(now)
        lease = self.lease
        local = by is None  # a program of the robot
        if by and run != PERSON and not lease.holds(key, by):  # a script elsewhere: its zero counts as a person's
            if moves:
                return REFUSED
            run = PERSON
        if lease.refuses(moves, run != PERSON or local, key, "" if local else by, now):  # scripts here need no key
            return REFUSED
        ours = run != PERSON or not lease.key or lease.holds(key, by)  # a script's, or no other client has control
        if newer(run, self.barred) and run != self._newest:  # it has begun, even if this command is refused
            self._newest = run
            self.bar(run - 1 or LAST_RUN)
        if self.latch.latched:
            self.bar(run)
        # the zero for which the latch waits after a reset is not that of a client without control
        if (moves or ours) and self.latch.refuses(moves, run != PERSON, now):
            return REFUSED
        limit = self._watchdog_ms if valid_ms < 0 or valid_ms > self._watchdog_ms else int(valid_ms)
        if run == PERSON:
            self._take(moves, valid_ms == 0 or not ours, now)  # final: it is valid for 0 ms, or another has control
        # a script is refused while a person holds the wheels, after the start, and if its run is barred
        elif self._held or self._starting or (run > 0 and not newer(run, self.barred)):
            return REFUSED
        else:
            self._scripted = True
            self._script_from = now
            self._script_ms = limit
        return limit if moves else 0

    def stop(self, name: str, by: str, why: str, since: int) -> bool:
        """Latch, and bar all runs so far; return False if this stop is known already."""
        if not self.latch.stop(name, by, why, since):
            return False
        self.bar(self._newest)
        self._scripted = False
        return True

    def tick(self, now: int) -> None:
        """End the wait of scripts and a script's command, if over. Call it at least every few minutes: clocks wrap."""
        diff = self._diff
        self.latch.tick(now)
        self.lease.tick(now)
        if self._starting and diff(now, self._started) >= HOLD_MS:
            self._starting = False
        if self._scripted and diff(now, self._script_from) >= self._script_ms:
            self._scripted = False
        if self._held and diff(now, self._held_from) >= HOLD_MS:
            self._held = False
            if not self._resumes:  # the person has not let go: the connection was lost
                self.bar(self._newest)

    def _take(self, moves: bool, final: bool, now: int) -> None:
        """Handle a person's command: scripts wait, or end. ``final``: a zero ends them in any case.

        A zero that is not ``final`` ends a script only if the script was driving until now. If the person was driving,
        the script waits already: the zero ends the person's driving, and the script goes on HOLD_MS later.
        """
        if not moves and (final or self._scripted):
            self.bar(self._newest)
        self._resumes = not moves and not final
        self._scripted = False
        self._held = True
        self._held_from = now

    def bar(self, run: int) -> None:
        """Bar all runs up to this one: none moves anything from now on."""
        if newer(run, self.barred):
            self.barred = run
            if newer(run, self._newest):
                self._newest = run
