"""Who has control of one motor owner, recomputed from what reached it; independent of lease.py.

What is promised, exactly:

* At most one client has control. Its key is new whenever control passes on, and halts the motors.
* A command that moves anything and has a key moves it only if that is the newest key and, with names, its account is
  that of who has control. A command without a key moves as strangers may. A zero is never refused.
* A script elsewhere moves nothing without the key of its account; where names are not checked, it needs none.
* Control ends by a release, by another who takes it, by the first who asks for it once 5 s are over in which it has
  moved nothing, or when neither request nor command came for ``for_ms``; then the first who asks gets it.
* After a restart control is free.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from tests.kit.schedules import check

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
