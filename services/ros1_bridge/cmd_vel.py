"""Sends commands to the base: the newest one repeatedly while it is valid, then zeros.

While the robot is stopped it sends zeros and a lock. It has a deadline and a thread of its own, so that the base stops
when the service hangs.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from math import inf

from pebble.runtime.rate_limit import RateLimitedLog
from pebble.services.ros1_bridge import messages
from pebble.services.ros1_bridge.node import Node

log = logging.getLogger(__name__)

ZERO = messages.twist(0.0, 0.0)
ZEROS = 5  # after the last command; then silence, so that other programs of ROS may drive
LATCHED_S = 0.1  # between two zeros while stopped
SILENT_S = 1.0  # a base that sent odometry, and sends none for so long, hangs
_PERIOD_S = 0.05  # between two repetitions, where the config says 0
_SURE_S = 2.0  # a subscriber that is still there so long after "unlocked" was sent has received it
_CANCEL_S = 1.0  # between two cancellations of a navigation that goes on
_END_S = 1.0  # longest wait for the thread at the end


class CmdVel:
    """The publisher of commands to the base, and of its lock. Its methods may be called on any thread.

    Unlocking is *owed* while this program has locked the base: ``save`` stores whether it is, and ``owed`` is what an
    earlier process has stored. A lock that this program has not set stays locked.
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        period_s: float,
        estop_topic: str | None,
        cancel_topic: str | None,
        *,
        owed: bool = False,
        save: Callable[[bool], object] = lambda _owed: None,
    ) -> None:
        definition = "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n"
        self._out = node.advertise(topic, messages.TWIST, definition)
        self._lock = node.advertise(estop_topic, messages.BOOL, "bool data\n") if estop_topic else None
        self._goals = (
            node.advertise(cancel_topic, messages.GOAL_ID, "time stamp\nstring id\n") if cancel_topic else None
        )
        self._period_s, self._save = period_s or _PERIOD_S, save
        self._changed = threading.Condition()
        self._body, self._until = ZERO, 0.0  # the newest command, and when it ends
        self._zeros = ZEROS  # how many are to be sent once it has ended
        self._latched = False
        self._owed = owed  # as stored
        self._has_set_lock = owed  # then a new subscriber of the lock is told its state
        self._unlocked_at = inf  # when the lock was last sent as open
        self._heard_at: float | None = None  # when the base last sent odometry
        self._cancelled_at = float("-inf")  # when the planner's goals were last cancelled
        self._ends = False  # the thread is to end
        self._due = 0.0  # when the thread sends next; infinite: not before something changes
        self._log = RateLimitedLog(log)
        self.held_back = 0  # moves that a hung base did not get
        self._out.first = lambda: ZERO
        if self._lock is not None:
            self._lock.first = self._first_lock
        self._thread = threading.Thread(target=self._run, name="ros-cmd-vel", daemon=True)

    def open(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """Send a zero, and nothing after it."""
        with self._changed:
            self._ends = True
            self._out.send(ZERO)
            self._changed.notify()
        self._thread.join(_END_S)

    @property
    def alive(self) -> bool:
        """True if the thread that repeats commands still runs."""
        return self._thread.is_alive()

    @property
    def bases(self) -> set[str]:
        """Names of the nodes that receive the commands."""
        return self._out.names

    @property
    def heard(self) -> bool:
        """True if the base has ever sent odometry."""
        return self._heard_at is not None

    @property
    def hangs(self) -> bool:
        """True if the base has sent odometry, but no longer does."""
        return self._heard_at is not None and time.monotonic() - self._heard_at > SILENT_S

    def hear(self) -> None:
        """Note that the base has sent odometry."""
        self._heard_at = time.monotonic()

    def drive(self, linear: float, angular: float, valid_s: float) -> None:
        """Move the base for ``valid_s`` seconds. A speed that is no finite number stops it."""
        try:
            body = messages.twist(linear, angular)
        except ValueError:
            self._log.warning("not finite", "a speed is no finite number: the base is stopped")
            self.halt()
            return
        with self._changed:
            if self._latched or self._ends:
                return
            now = time.monotonic()
            self._body, self._until, self._zeros = body, now + valid_s, ZEROS
            self._send()
            self._plan(now)

    def halt(self) -> None:
        """Stop the base now."""
        with self._changed:
            self._body, self._until, self._zeros = ZERO, 0.0, ZEROS
            if not self._ends:
                self._out.send(ZERO)
            if not self._latched:  # else each call would put off the next repetition of the lock
                self._plan(time.monotonic())

    def latch(self, latched: bool) -> None:
        """Lock or unlock the base. A lock ends the command, keeps other ROS programs out, cancels their goals."""
        with self._changed:
            if latched is self._latched:
                return
            self._latched = latched
            self._body, self._until, self._zeros = ZERO, 0.0, ZEROS
            self._out.send(ZERO)
            self._has_set_lock = True  # from the first lock on, new subscribers are told the state
            self._unlocked_at = inf
            self._send_lock()
            if latched:
                self._owe(True)  # does not wait for the disk: another thread writes the file
                self._cancel()
            self._plan(time.monotonic())

    def cancel_navigation(self) -> None:
        """Cancel the goals of the planner, once a second at most."""
        with self._changed:
            if time.monotonic() - self._cancelled_at >= _CANCEL_S:
                self._log.log("cancel", logging.INFO, "a person drives: the goals of the planner are cancelled")
                self._cancel()

    def _cancel(self) -> None:
        self._cancelled_at = time.monotonic()
        if self._goals is not None:
            self._goals.send(messages.CANCEL_ALL)

    def _owe(self, owed: bool) -> None:
        """Store whether the base is locked by this program, which then has to unlock it."""
        if self._lock is not None and owed is not self._owed:
            self._owed = owed
            self._save(owed)

    def _first_lock(self) -> bytes | None:
        """Return the lock's state for a new subscriber; None if it was never set. Called on the thread of sockets."""
        if not self._has_set_lock:
            return None
        self._unlocked_at = inf if self._latched else time.monotonic()
        return messages.boolean(self._latched)

    def _send_lock(self) -> None:
        if self._lock is not None and self._lock.send(messages.boolean(self._latched)) and not self._latched:
            self._unlocked_at = time.monotonic()

    def settle(self) -> None:
        """Owe nothing more once a subscriber has had time to receive that the lock is open, and is still connected.

        Any subscriber, also a recorder: no name tells which of them keeps the lock. One that misses it stays locked
        until the next reset. To wait for all would be worse: a later process could open a lock that others have set.
        """
        with self._changed:
            was_told = time.monotonic() - self._unlocked_at > _SURE_S
            if self._lock is not None and self._lock.names and was_told and not self._latched:
                self._owe(False)

    def _send(self) -> None:
        """Send the command; a base that hangs gets zeros, so that it does not move when it goes on."""
        if self._body != ZERO and self.hangs:
            self.held_back += 1
            self._log.warning("hangs", "the base sends no odometry: it gets zeros instead of commands")
            self._body, self._until = ZERO, 0.0
        self._out.send(self._body)

    def _plan(self, now: float) -> None:
        """Set the time of the thread's next message, and wake the thread if it would sleep longer."""
        if self._body != ZERO:
            due = min(now + self._period_s, self._until)
        elif self._zeros > 0:
            due = now + self._period_s
        else:
            due = now + LATCHED_S if self._latched else inf
        if due < self._due:
            self._changed.notify()
        self._due = due

    def _run(self) -> None:
        """Send what is due: the newest command while it is valid, then zeros; while stopped, zeros with the lock."""
        with self._changed:
            while not self._ends:
                now = time.monotonic()
                if now < self._due:
                    self._changed.wait(None if self._due == inf else self._due - now)
                    continue
                if now < self._until:
                    self._send()
                elif self._latched or self._zeros > 0 or self._body != ZERO:
                    self._body, self._zeros = ZERO, max(0, self._zeros - 1)
                    self._out.send(ZERO)
                    if self._latched:
                        self._send_lock()
                self._plan(now)
