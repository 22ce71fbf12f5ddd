"""Repeats a stop to every motor owner until that owner has confirmed it. Kept in memory only; no I/O.

A stop that is sent once must not be lost because an owner restarts or is suspended. For each owner the newest stop
waits, and is repeated, until a state of that owner names it. A stop whose name was forgotten for room counts as new.
"""

import secrets
import threading
from collections.abc import Callable, Iterable
from math import inf
from typing import Any

import msgspec
from msgspec import UNSET, Struct

from pebble.contract import ESTOP, codec
from pebble.contract.payloads import EstopCommand, EstopState

REPEAT_S = 0.5
STATE_S = 1.2  # by then an owner has published a state after each stop: it may wait for others (pebble.motors.paced)
WITHDRAWN_S = 60.0  # so long an owner may have no emergency stop before its pending one ends
NAMES = 1024  # of stops: a minute of 17 in a second


def is_named(payload: bytes) -> bool:
    return bool(payload) and codec.decode(ESTOP, payload).stop is not UNSET


def named(payload: bytes) -> bytes:
    """Return a stop with a name, and without an owner, which only the bridge may add."""
    if not payload:  # no stop: it removes a retained message
        return payload
    stop = codec.decode(ESTOP, payload)
    if stop.stop is not UNSET and stop.owner is UNSET:
        return payload
    name = secrets.token_hex(8) if stop.stop is UNSET else stop.stop
    return _encoded(stop, stop=name, owner=UNSET)


class Pending(Struct, frozen=True):
    """A stop that an owner has not confirmed. ``first``: when it first came; ``at``: when the copy that waits came.

    ``enough``: if the owner receives the stop without its name, its boot and the count that confirms the stop, too.
    """

    stop: EstopCommand
    first: float
    at: float
    enough: tuple[str, int] | None

    def is_confirmed(self, state: EstopState) -> bool:
        """True if ``state`` shows the stop, except while a latched owner still has to save it."""
        counts = self.enough is not None and self.enough[0] == state.boot and state.count >= self.enough[1]
        return (counts or str(self.stop.stop) in state.recent) and _is_saved(state)


class Owner:
    """The known state of one motor owner."""

    def __init__(self) -> None:
        self.state: EstopState | None = None
        self.pending: Pending | None = None
        self.freed_at = -inf  # when it was last seen free after a stop
        self.withdrawn_at: float | None = None  # since when it publishes that it has no emergency stop
        self._expected = 0  # its count once it has received every stop that was passed to it

    def expect(self, stop: EstopCommand, first: float, now: float, *, nameless: bool) -> None:
        """Let this newest stop wait. A count does not tell which stops the owner has received: it must include all."""
        state = self.state
        self._expected = max(self._expected, 0 if state is None else state.count) + 1
        enough = (state.boot, self._expected) if nameless and state is not None else None
        self.pending = Pending(stop, first, now, enough)

    def has_had(self, name: str) -> bool:
        """True if the owner's newest state names this stop."""
        return self.state is not None and name in self.state.recent

    def needs_it_again(self, now: float) -> bool:
        """True if the pending stop is to be repeated. A nameless one only if it was lost: it would be another stop."""
        if self.pending is None or self.withdrawn_at is not None:
            return False
        enough, state = self.pending.enough, self.state
        if enough is None or state is None or state.boot != enough[0]:
            return True
        return state.count < enough[1] and now - self.pending.at >= STATE_S

    def confirms(self, name: str) -> bool:
        """True if the owner's newest state names this stop, except while a latched owner still has to save it."""
        return self.state is not None and self.has_had(name) and _is_saved(self.state)

    def follow(self, state: EstopState | None, now: float) -> None:
        """Note the owner's newest state; None: the owner has withdrawn it."""
        earlier, self.state = self.state, state
        if state is None:
            if self.withdrawn_at is None:
                self.withdrawn_at = now
            return
        self.withdrawn_at = None
        # Not after a restart: an older file may have freed it. A greater count shows a stop between two states.
        was_stopped = (
            earlier is not None and earlier.boot == state.boot and (earlier.latched or state.count > earlier.count)
        )
        if was_stopped and not state.latched:
            self.freed_at = now
        if self.pending is not None and self.pending.is_confirmed(state):
            self.pending = None
        if self.pending is None or earlier is None or earlier.boot != state.boot:
            self._expected = state.count


def _is_saved(state: EstopState) -> bool:
    return state.persisted is not False or not state.latched


class PassedStops:
    """The stops that were forwarded, and those that owners have not confirmed. Any thread may use it."""

    def __init__(self, owners: Iterable[str], clock: Callable[[], float]) -> None:
        self._owners = {owner: Owner() for owner in owners}
        self._clock = clock
        self._lock = threading.Lock()
        self._passed: dict[str, float] = {}  # when a stop was forwarded first, by its name; the oldest stop first

    @property
    def pending(self) -> dict[str, Pending]:
        """Stops that are not confirmed, by owner."""
        return {key: owner.pending for key, owner in self._owners.items() if owner.pending is not None}

    def accept(self, payload: bytes, *, nameless: bool = False) -> list[bytes]:
        """Remember a named stop as forwarded, and expect owners to confirm it; return the payloads to publish.

        If owners were reset since it first came, and need not confirm it, only the others get it: a copy for each.
        ``nameless``: the owners receive it from its sender, too, without this name.
        """
        if not payload:
            return [payload]
        stop = codec.decode(ESTOP, payload)
        now, name = self._clock(), str(stop.stop)
        with self._lock:
            is_copy = name in self._passed
            first = self._passed.setdefault(name, now)
            if len(self._passed) > NAMES:
                del self._passed[next(iter(self._passed))]
            waiting = {key for key, pending in self.pending.items() if pending.stop.stop == name}  # not confirmed yet
            reset_since = {key for key, owner in self._owners.items() if owner.freed_at > first} - waiting
            if reset_since:  # this repeats a stop that a reset has ended there: only the other owners get a copy
                return [_encoded(stop, owner=key) for key in self._owners if key not in reset_since]
            for key, owner in self._owners.items():  # the newest stop stays pending, also if an older one comes again
                pending = owner.pending
                is_older = pending is not None and (owner.has_had(name) or (is_copy and pending.first >= first))
                if key not in waiting and not is_older and not owner.confirms(name):
                    owner.expect(stop, first, now, nameless=nameless)
        return [payload]

    def follow(self, owner: str, state: EstopState | None) -> None:
        """Note the newest state of an owner; None: the state was withdrawn."""
        with self._lock:
            self._owners[owner].follow(state, self._clock())

    def repeat(self) -> list[bytes]:
        """Return the payloads to publish again, on the local side only; call this every ``REPEAT_S``."""
        now = self._clock()
        with self._lock:
            waiting = self.pending.items()
            return [_encoded(stop.stop, owner=key) for key, stop in waiting if self._owners[key].needs_it_again(now)]

    def give_up(self) -> list[tuple[str, EstopCommand]]:
        """End the stops for owners whose state was withdrawn for too long; return them, each with its owner."""
        now, ended = self._clock(), []
        with self._lock:
            for key, pending in self.pending.items():
                since = self._owners[key].withdrawn_at
                if since is not None and now - max(since, pending.at) > WITHDRAWN_S:
                    self._owners[key].pending = None
                    ended.append((key, pending.stop))
        return ended


def _encoded(command: EstopCommand, **fields: Any) -> bytes:
    """Return a stop with these fields as JSON, in which empty texts are left out."""
    sender = {"by": command.by or UNSET, "why": command.why or UNSET}
    return codec.encode(ESTOP, msgspec.structs.replace(command, **(sender | fields)))
