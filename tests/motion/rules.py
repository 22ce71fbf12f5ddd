"""What one motor owner may do and who has control of it, recomputed from what reached it; independent of the cores.

What is promised, exactly:

* No wheel turns while its owner is latched, after its command's deadline, or by a run that is barred.
* A stop is confirmed only after every owner that the robot lists has executed it and has answered. Until it is saved,
  too, for at most 60 s or as long as a hold lasts, its sender sends it and a final zero every 0.5 s; then nothing.
* A state with ``persisted`` true is on the disk: of a board whether it is stopped, of others the names, too.
* A stop that is confirmed and saved survives a power cut of every owner, unless a reset that was asked for after it has
  ended it, or the owner's file has been removed. A file that is damaged or cannot be read counts as a stop.
  An owner that can save nothing (``persisted`` null) confirms, but is free after a power cut: its sender must report
  it as not saved. An owner whose writing fails (``persisted`` false) is stopped, and its sender goes on.
* A reset ends a stop only if its ``boot`` and ``count`` are the newest and it was read less than 1 s ago, so it never
  ends a stop that was given after it was asked for.
* Once everything works, senders and holds come to rest, and one reset by a person who looked ends every stop.
* A run that is barred moves nothing in this life of the owner, and nothing in the first 2 s of the next; later only
  while its manager has not received the state of the new life.
* A person's zero is always judged, and stops the motors.
* A retained copy of a command has no effect.
* At most one client has control. Its key is new whenever control passes on, and halts the motors.
* A command that moves anything and has a key moves it only if that is the newest key and, with names, its account is
  that of who has control. A command without a key moves as strangers may. A zero is never refused.
* A script elsewhere moves nothing without the key of its account; where names are not checked, it needs none.
* Control ends by a release, by another who takes it, by the first who asks for it once 5 s are over in which it has
  moved nothing, or when neither request nor command came for ``for_ms``; then the first who asks gets it.
* After a restart control is free.

Times are milliseconds that never wrap. ``order`` counts the steps of a history: a press and a request for a reset have
the order of the step in which a person made them, however late they arrive.
"""

from __future__ import annotations

from collections import Counter
from typing import Any, NamedTuple

from tests.kit.schedules import ViolatedError, check

IDLE_MS = 5000
OTHERS_MS = 2000


class Client(NamedTuple):
    """A person who drives: below the level of names the account is empty, and only the id counts."""

    account: str
    id: str
    by: str
    device: str = ""


class ControlRules:
    """The rules of one life of an owner. The events are called after it has executed them; ``lease`` is its own."""

    def __init__(self, strangers: int, lease: Any) -> None:
        self.strangers, self._lease = strangers, lease
        self._keys: list[str] = []
        self._holder: Client | None = None
        self._for = self._until = self._idle_at = 0
        self._passed_on = False
        self._asker: Client | None = None
        self._asks_until = self._asks_for = 0
        self._others_until: int | None = None

    def requested(self, who: Client, for_ms: int, over: bool, now: int) -> None:
        self._pass(now)
        for_ms = max(1000, min(for_ms, 10_000))
        if self._is(who, self._holder):
            self._for, self._until = for_ms, now + for_ms
        elif self._holder is None or over or now >= self._idle_at:
            self._give(who, for_ms, now)
        elif self._asker is None or self._is(who, self._asker):
            self._asker, self._asks_for, self._asks_until = who, for_ms, now + for_ms
        self._compare()

    def released(self, who: Client, now: int) -> None:
        self._pass(now)
        if self._is(who, self._holder):
            self._end(now)
        elif self._is(who, self._asker):
            self._asker = None
        self._compare()

    def commanded(self, moves: bool, person: bool, key: str, by: str | None, now: int) -> tuple[bool, bool, bool]:
        """Whether a command is permitted; is from who drives: then its zero is a letting go; and is a person's."""
        self._pass(now)
        self._learn_key()
        mine = self._holder is not None and self._keys[-1] in key.split(" ") and by == self._holder.account
        if mine:
            self._until = now + self._for
        script = not person and (mine or not by)  # elsewhere it needs the key; else its zero is as a person's
        local = by is None or script
        stranger = person and (self.strangers == 0 or (self.strangers == 1 and self._holder is None))
        permitted = not moves or mine or (not key and (local or stranger))
        if moves and mine:
            self._idle_at = now + IDLE_MS
        elif moves and permitted and not local:
            self._others_until = now + OTHERS_MS
        return permitted, script or mine or self._holder is None, not script

    def ticked(self, now: int) -> None:
        self._pass(now)
        self._compare()

    def _is(self, who: Client, other: Client | None) -> bool:
        return other is not None and who.id == other.id and who.account == other.account

    def _pass(self, now: int) -> None:
        if self._others_until is not None and now >= self._others_until:
            self._others_until = None
        if self._asker is not None and now >= self._asks_until:
            self._asker = None
        ends_at = self._until if self._asker is None else min(self._until, self._idle_at)
        if self._holder is not None and now >= ends_at:
            self._end(now)

    def _end(self, now: int) -> None:
        if self._asker is None:
            self._holder = None
        else:
            self._give(self._asker, self._asks_for, now)

    def _give(self, who: Client, for_ms: int, now: int) -> None:
        self._holder, self._asker = who, None
        self._for, self._until, self._idle_at = for_ms, now + for_ms, now + IDLE_MS
        self._passed_on = True

    def _learn_key(self) -> None:
        """Control may have passed on more than once: the key of now counts."""
        key, passed_on, self._passed_on = self._lease.key, self._passed_on, False
        if passed_on and self._holder is not None:
            check(key not in self._keys and len(key) == 8, "a key is not new when control passes on")
            self._keys.append(key)

    def _compare(self) -> None:
        self._learn_key()
        lease = self._lease
        check(lease.holder == (self._holder or ()), "somebody has control who must not, or the other way round")
        check(lease.asker == (self._asker or ()), "somebody counts as asking who does not, or the other way round")
        check(lease.key == (self._keys[-1] if self._holder else ""), "a key is valid of which nobody has control")
        check(lease.others == (self._others_until is not None), "it is not shown that others drive, too")


WATCHDOG_MS = 750
HOLD_MS = 2000
START_MS = 2000
QUIET_MS = 500
OLD_MS = 1000
REPEAT_MS = 500
GIVE_UP_MS = 60_000

PERSON, UNKNOWN_RUN, REFUSED = 0, -1, -1

MISSING = "missing"  # in place of a file's content
UNREADABLE = "unreadable"


class Rules:
    """The rules of one owner. The events are called after the owner has executed them, with what it did."""

    control: ControlRules  # of this life

    def __init__(self, names: int) -> None:
        self.names = names
        self.ended = -1  # when a reset last ended the stop, or its file was removed
        self.newest_given = -1  # the newest stop that was executed, by when it was given
        self.counted: dict[str, int] = {}  # stops by when they were executed
        self.confirmed: dict[str, int] = {}  # saved stops of a sender that was confirmed, by when that was published
        self.barred_before = 0  # by earlier lives
        self.latched = False
        self.recent: list[str] = []
        self.started(0, MISSING, False)

    def snapshot(self) -> tuple[bool, list[str]]:
        """What a file that is written now must contain."""
        return self.latched, self.recent

    def started(self, now: int, saved: Any, latched: bool) -> None:
        """``saved``: a snapshot, MISSING or UNREADABLE."""
        if saved == MISSING:
            self.latched, self.recent = False, []
        elif saved == UNREADABLE:
            self.latched, self.recent = True, []
        else:
            self.latched, self.recent = saved
        lost = [name for name, published in self.confirmed.items() if published >= self.counted[name] > self.ended]
        check(latched or not lost, "a confirmed stop does not survive a restart")
        check(latched == self.latched, "an owner does not start as its file has it")
        self.senders: dict[str, str] = {}  # of names of this life
        self.zeros = 0  # of persons, that wait
        self.count = 0
        self.barred_before = max(self.barred_before, getattr(self, "barred", 0))
        self.barred = self.newest = 0
        self.since = now
        self.person_at: int | None = None  # when a person's command was last executed
        self.released = False
        self.script_until: int | None = None  # the last command is a script's
        self.quiet_from: int | None = None  # after a reset
        self.key = ""  # of control

    def executes(self, copy: bool) -> None:
        """A command is executed; ``copy``: it was delivered as a retained one."""
        check(not copy, "a retained copy of a command has an effect")

    def confirms(self, name: str, state: dict[str, Any] | None) -> None:
        """A sender takes its stop as confirmed; ``state`` is the newest one that it has received from this owner."""
        if state is None or name not in self.counted:
            raise ViolatedError("a stop is confirmed without an owner that has executed it and answered")
        if state["persisted"]:
            self.confirmed[name] = state["order"]

    def saved(self, durable: Any, names: bool) -> None:
        """A state has ``persisted`` true; ``durable`` is what a power cut leaves, as in ``started``."""
        special = {MISSING: (False, []), UNREADABLE: (True, [])}
        latched, recent = special[durable] if isinstance(durable, str) else durable
        check(
            latched == self.latched and (recent == self.recent or not names),
            "a state that counts as saved is not on the disk",
        )

    def stopped(self, name: str, by: str, given: int, order: int, latch: Any, moving: bool) -> None:
        """A stop was executed."""
        self.newest_given = max(self.newest_given, given)
        if name not in self.recent:
            self.recent = [name, *self.recent]
            self.senders[name] = by.partition("/")[0]
            if len(self.recent) > self.names:
                self.recent.remove(self._least_needed())
            self.counted[name] = order
            self.count += 1
            self.latched = True
            self.barred = max(self.barred, self.newest)
            self.script_until = self.quiet_from = None
            check(not moving, "a wheel turns after a stop")
        check(latch.latched == self.latched, "a stop that is new latches, and a known one changes nothing")
        check(latch.count == self.count and latch.recent == self.recent, "names and number of stops are not right")

    def _least_needed(self) -> str:
        """The oldest name of before the start, else of the sender that has the most."""
        senders = Counter(self.senders[name] for name in self.recent if name in self.senders)
        most = [by for by, number in senders.items() if number == max(senders.values())]
        old = [name for name in self.recent if name not in self.senders]
        return (old or [name for name in self.recent if self.senders[name] in most])[-1]

    def reset(self, boot: str, count: int, age: int, asked: int, now: int, order: int, latch: Any) -> None:
        """A reset was executed, or refused."""
        ended = self.latched and not latch.latched
        if ended:
            check(self.newest_given < asked, "a reset clears a stop that was given after it was asked for")
            self.latched = False
            self.ended, self.quiet_from = order, now
        allowed = boot == latch.boot and count == self.count and age < OLD_MS
        check(not ended or allowed, "a reset that must be refused is obeyed")
        check(not allowed or not latch.latched, "a reset of the newest state is refused")
        check(latch.latched == self.latched, "a reset latches")

    def received(self, moves: bool, run: int) -> None:
        """A drive command is in the inbox."""
        self.zeros += not moves and run == PERSON

    def worked(self) -> None:
        """All that was in the inbox has been executed."""
        check(self.zeros <= 0, "a person's zero is not judged")
        self.zeros = 0

    def judged(self, moves: bool, run: int, valid_ms: float, key: str, by: str | None, now: int, result: int) -> None:
        """A drive command was judged; ``result`` is the milliseconds for which it moves, 0 or REFUSED."""
        self._end_hold(now)
        self.zeros -= not moves and run == PERSON
        permitted, ours, person = self.control.commanded(moves, run == PERSON, key, by, now)
        run = PERSON if person else run
        if not permitted:
            check(result == REFUSED, "something moves by a key of before, another's name or a stranger")
            return
        limit = min(WATCHDOG_MS, int(valid_ms)) if valid_ms >= 0 else WATCHDOG_MS
        held = self.person_at is not None
        if run > self.newest:
            self.newest = run
            self.barred = max(self.barred, run - 1)
        if self.latched:
            self.barred = max(self.barred, run)
            check(result <= 0, "a wheel turns while its owner is latched")
        if run == PERSON:
            quiet = self._quiet(moves, ours, now)
            if not moves:
                check(result == 0, "a person's zero is not judged")
            elif self.latched or not quiet:
                check(result == REFUSED, "a person moves wheels before letting go after a reset")
                return
            else:
                check(result == limit, "a person's command is refused, or lasts too long or too short")
            self._take(moves, valid_ms == 0 or not ours, now)
            return
        if moves and 0 < run <= self.barred:
            check(result == REFUSED, "a barred run moves")
        if held or now - self.since < START_MS or 0 < run <= self.barred or (moves and self.latched):
            check(result == REFUSED, "a script's command has an effect while a person drives, at the start or barred")
            return
        check(result == (limit if moves else 0), "a script's command is refused, or lasts too long or too short")
        self.script_until = now + limit

    def passed_on(self, key: str, moving: bool) -> None:
        """``key`` is the owner's now; ``moving``: a wheel turns, or will."""
        check(key == self.key or not moving, "a wheel turns on when control passes on")
        self.key = key

    def moving(self, now: int, until: int) -> None:
        """A wheel turns at ``now``, by a command whose deadline is ``until``."""
        check(not self.latched, "a wheel turns while its owner is latched")
        check(now < until, "a wheel turns after its command's deadline")

    def _quiet(self, moves: bool, ours: bool, now: int) -> bool:
        """Whether persons have let go since the reset: who has control, if anybody has."""
        if self.latched or self.quiet_from is None:
            return True
        if (not moves and ours) or now - self.quiet_from >= QUIET_MS:
            self.quiet_from = None
            return True
        self.quiet_from = now if moves else self.quiet_from
        return False

    def _take(self, moves: bool, final: bool, now: int) -> None:
        in_effect = self.script_until is not None and now < self.script_until
        if not moves and (final or in_effect):
            self.barred = max(self.barred, self.newest)
        self.released = not moves and not final
        self.person_at = now
        self.script_until = None

    def _end_hold(self, now: int) -> None:
        if self.person_at is not None and now - self.person_at >= HOLD_MS:
            self.person_at = None
            if not self.released:
                self.barred = max(self.barred, self.newest)

    def ticked(self, now: int, barred: int) -> None:
        """Time has passed; ``barred`` is the owner's."""
        self._end_hold(now)
        self.control.ticked(now)
        check(barred == self.barred, "a run is barred that is not, or the other way round")

    def file_removed(self, order: int) -> None:
        """Nothing is promised of the stops before."""
        self.ended = order
