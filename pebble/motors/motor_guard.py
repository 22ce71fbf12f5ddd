"""Decides which drive commands move the motors of an owner, and stops them: latch, arbiter and deadline."""

import logging
import operator
import secrets
import time
from collections.abc import Callable
from typing import Any

from msgspec import UNSET

from pebble.contract.payloads import LAST_RUN, Drive, EstopCommand, EstopReset, EstopState
from pebble.motion.arbiter import HOLD_MS, PERSON, REFUSED, Arbiter, newer
from pebble.motion.latch import Latch, stop_of
from pebble.motors.control import Control, earliest, ms
from pebble.motors.motion_inbox import run_of
from pebble.motors.paced import Paced
from pebble.motors.state_file import StateFile
from pebble.runtime.rate_limit import RateLimitedLog
from pebble.transports.counters import Counters

log = logging.getLogger(__name__)

NAMES = 8  # names of stops that are remembered
_REPEAT_S = 0.25  # a repetition that comes sooner after a state was sent before that arrived: it needs no answer
_HOLD_S = HOLD_MS / 1000 + 0.01  # the arbiter counts whole milliseconds


#: By ``reset_refused``.
_REFUSED_RESETS = {
    "boot": "it is for another motor owner, or for this one before it restarted",
    "count": "another stop has been received since",
    "old": "it was received too long ago",
}


class MotorGuard:
    """The emergency stop and the arbiter of a Linux robot's motor owner; on the service's thread.

    Call :meth:`begin` first, and :meth:`tick` at :attr:`due`. ``publish(state)`` is called with each new state, at most
    four times a second. ``file`` keeps the stop over a power cut, ``barred_file`` barred runs over a restart.
    """

    def __init__(
        self,
        file: StateFile,
        barred_file: StateFile,
        publish: Callable[[EstopState], object],
        counters: Counters,
        control: Control,
        *,
        watchdog_s: float,
        now: float,
    ) -> None:
        self._file, self._barred_file, self._counters, self._control = file, barred_file, counters, control
        self._state = Paced(lambda: publish(self.state()))
        self._latch = Latch(control.boot, NAMES, operator.sub)  # this clock does not wrap, as an MCU's does
        self._arbiter = Arbiter(self._latch, control.lease, ms(now), operator.sub, round(1000 * watchdog_s))
        self._saving = self._saved = 0  # numbers of writes: the newest one, and the newest one that succeeded
        self._hold_until: float | None = None  # the end of the hold of the person who commanded last
        self._barred = 0  # the newest barred run, as saved and published last
        self._log = RateLimitedLog(log, burst=5)
        self._can_save = False  # the file can be written, as far as :meth:`begin` and :meth:`save_again` know

    def begin(self, now: float) -> None:
        """Continue with the state in the file, and publish it."""
        self._can_save = self._file.can_save()
        if not self._can_save:
            log.warning("%s cannot be written: an emergency stop ends with a power cut", self._file.path)
        saved = self._file.load()
        if saved is not None:
            self._latch.restore(saved)
            self._save()  # again: the process that wrote it may have been killed before it was on the disk
        barred = self._barred_file.load()
        if type(barred) is int and 0 < barred <= LAST_RUN:
            self._arbiter.bar(barred)
            self._barred = barred
        if self.latched:
            self._log.log("stop", logging.WARNING, "still stopped by %s", _described(self._latch.by, self._latch.why))
        self._state.changed(now)

    @property
    def latched(self) -> bool:
        return self._latch.latched

    @property
    def persisted(self) -> bool | None:
        """True if the file holds the current state; None if this owner cannot save."""
        if not self._can_save:
            return None
        return self._saving == self._saved

    def stop(self, command: EstopCommand, now: float) -> None:
        """Latch an emergency stop. The caller must have stopped the motors before."""
        name = command.stop if isinstance(command.stop, str) else secrets.token_hex(8)
        by, why, earlier_by = _given(command.by), _given(command.why), self._latch.by
        if self._arbiter.stop(name, by, why, time.time_ns() // 1_000_000):
            self._log.log("stop", logging.WARNING, "emergency stop by %s", _described(by, why))
            self._save()
            self._state.changed(now)
        elif self._latch.by != earlier_by:  # the same stop again, now with a sender that was checked
            self._save()
            self._state.changed(now)
        elif now >= self._state.last + _REPEAT_S:  # the sender may have missed the answer
            self._state.changed(now)

    def reset(self, reset: EstopReset, age_s: float, now: float) -> None:
        if self._latch.reset(reset.boot, reset.count, ms(age_s), ms(now)):
            self._log.log("reset", logging.WARNING, "emergency stop reset by %s", _described(_given(reset.by), ""))
            self._save()
        elif self._latch.reset_refused:  # else it was not latched
            why = _REFUSED_RESETS[self._latch.reset_refused]
            self._log.log("refused", logging.WARNING, "refused a reset: %s", why)
        self._state.changed(now)  # a refusal is part of the state

    def judge(self, drive: Drive, now: float) -> float | None:
        """Judge a drive command; return the seconds for which it moves the motors (0: stop), None if it is refused."""
        valid_ms = drive.valid_ms if isinstance(drive.valid_ms, int) else -1
        run = run_of(drive)
        key = drive.key if isinstance(drive.key, str) else ""
        account = self._control.account(drive)
        limit: int = self._arbiter.judge(drive.moves, run, valid_ms, ms(now), key, account)
        self._note_barred(now)
        if limit == REFUSED:  # by the latch, the arbiter or the lease, which is asked again for the reason alone
            needs_no_key = run != PERSON or account is None  # a script, or another program of the robot
            is_stranger = self._control.lease.refuses(drive.moves, needs_no_key, key, account or "", ms(now))
            reason = self._reason_of_refusal(drive.moves, is_stranger, now)
            self._counters.add(reason)
            if drive.moves or run == PERSON:  # a script's zero is only to bar older runs, which the arbiter has done
                self._log.warning(reason, "refused a drive command: %s", self._why_refused(reason, run, key))
            return None
        if run == PERSON:
            self._hold_until = now + _HOLD_S
        return min(limit, self._control.left_ms(now)) / 1000

    def bar(self, run: int, now: float) -> None:
        """Bar the script runs that another motor owner of the robot has barred."""
        self._arbiter.bar(run)
        self._note_barred(now)

    @property
    def barred(self) -> int:
        return self._barred

    @property
    def due(self) -> float | None:
        """Time at which :meth:`tick` must run next; None if nothing is due."""
        return earliest(self._state.due, self._hold_until)

    def tick(self, now: float) -> None:
        """End the wait of scripts after a person's command once it is over, and publish a state that had to wait."""
        if self._hold_until is not None and now >= self._hold_until:
            self._hold_until = None
            self._arbiter.tick(ms(now))
            self._note_barred(now)
        self._state.tick(now)

    def on_saved(self, number: int, succeeded: bool, now: float) -> None:
        """Note the result of write ``number`` of the file."""
        if succeeded:
            self._saved = number
        if number == self._saving:
            self._state.changed(now)

    def save_again(self) -> None:
        """Write the file as soon as that is possible; write it again if the last write failed, or the file was removed.

        It is not written again while a write is still running, or in a folder that is lost, where every write fails.
        """
        if not self._can_save and self._file.can_save():
            self._can_save = True
            self._save()
        elif not self._file.busy and (self.persisted is False or not self._file.in_place) and not self._file.lost:
            self._save()
        if self._barred and not self._barred_file.busy and not self._barred_file.in_place:
            self._barred_file.save(self._barred)

    def appeared_stop(self) -> EstopCommand | None:
        """Return a stop that this owner does not know, from a file on a disk that was mounted late, or None.

        A file that has appeared without such a stop is overwritten with the state here, which is newer.
        """
        saved = None if self._file.busy or not self._can_save else self._file.appeared()
        if saved is None:
            return None
        latch = Latch("", NAMES, operator.sub)
        latch.restore(saved)
        newest = latch.recent[0] if latch.recent else secrets.token_hex(8)  # an unreadable file is a stop, too
        if latch.latched and not self.latched and newest not in self._latch.recent:
            log.warning("%s has appeared, with an emergency stop", self._file.path)
            return EstopCommand(stop=newest, by=latch.by, why=latch.why)
        self._save()  # the state here is newer
        return None

    def repeat_state(self, now: float) -> None:
        """Publish the state again, because a broker that was restored from a save retains an older state."""
        self._state.changed(now)

    def state(self) -> EstopState:
        fields: dict[str, Any] = self._latch.state(self.persisted)
        return EstopState(**fields, barred=self._barred or UNSET)

    def _reason_of_refusal(self, moves: bool, is_stranger: bool, now: float) -> str:
        """Return the reason of a refusal, as a counter's name; ``is_stranger``: the sender does not have control."""
        if moves and self._control.waits(now):
            return "handover"
        if is_stranger:
            return "stranger"
        return "latched" if self.latched else "overruled"

    def _why_refused(self, reason: str, run: int, key: str) -> str:
        if reason == "handover":
            return "the robot's motor owners do not follow the same holder yet"
        if reason == "stranger":
            return "its key of control is not the one of now" if key else "only who has control may drive"
        if reason == "latched":
            return "the robot is stopped"
        if run == PERSON:
            return "after the reset no zero and no pause was received yet"
        if run > 0 and not newer(run, self._arbiter.barred):
            return f"run {run} has ended"
        return f"run {run} has to wait: a person drives, or this process has just started"

    def _note_barred(self, now: float) -> None:
        """Save and publish the newest barred run, if the arbiter has barred another one."""
        if self._arbiter.barred != self._barred:
            self._barred = self._arbiter.barred
            self._barred_file.save(self._barred)
            self._state.changed(now)

    def _save(self) -> None:
        if self._can_save:
            self._saving = self._file.save(self._latch.saved())


def _described(by: str, why: str) -> str:
    """Return the sender and the reason of a stop or a reset, for the log."""
    _, by, why = stop_of({"by": by, "why": why})  # in printable characters
    sender = by or "an unnamed sender"
    return f"{sender} ({why})" if why else sender


def _given(text: object) -> str:
    return text if isinstance(text, str) else ""
