"""Rows of the audit before they are written: each account has a quota of each kind, beyond it they merge. Pure."""

from typing import Any

from pebble.contract.names import NO_ACCOUNT
from pebble.motion.lease import shown

ACCOUNTS = 100  # that have rows of their own
WAITING = 1000  # rows that are not written yet
OTHERS = "(others)"  # in place of an account, like
ROBOT = "(robot)"  # a program of the robot: no account has such a name
UNKNOWN = "?"  # in place of an account: the name was not checked
_NAME = 40  # characters of a sender
_HOLD_S = 0.3  # a stop comes on two topics: what the second one tells is still put into the row

Row = dict[str, Any]


class _Room:
    """What one account may still write of one kind, and the row into which the rest merges."""

    __slots__ = ("at", "left", "merged")

    def __init__(self, burst: float, now: float) -> None:
        self.left, self.at = burst, now
        self.merged: Row | None = None


class AuditRows:
    """At most ``burst`` rows at once of each account and kind, then one each ``period_s`` with the ``count`` of all.

    So no account can write so much that it displaces what others did. Times are seconds of the caller's clock. What
    was taken is to be confirmed (``written``) or given back before more is taken.
    """

    def __init__(self, burst: int, period_s: float) -> None:
        self._burst, self._period_s = burst, period_s
        self._rooms: dict[str, dict[object, _Room]] = {}  # by account, then kind
        self._waiting: list[tuple[float, Row]] = []
        self._taken = 0  # rows that are being written, and may come back

    def add(self, row: Row, account: str, now: float) -> bool:
        """Whether ``row`` will be written as it is; ``row["what"]`` is its kind."""
        rooms = self._rooms_of(account, now)
        if rooms is None:
            row["who"], rooms = OTHERS, self._rooms.setdefault(OTHERS, {})
        room = rooms.setdefault(row["what"], _Room(self._burst, now))
        self._fill(room, now)
        if room.left >= 1 and room.merged is None and self._taken + len(self._waiting) < WAITING:
            room.left -= 1
            self._waiting.append((now, row))
            return True
        merged = room.merged
        if merged is None:
            room.merged = {**row, "since": row["t"], "count": 1}
        else:
            room.merged = {**row, "since": merged["since"], "count": merged["count"] + 1}
        return False

    def waits(self, row: Row) -> bool:
        return any(one is row for _, one in self._waiting)

    def take(self, now: float, *, all_of_them: bool = False) -> list[Row]:
        """What is to be written now, the oldest first."""
        ready = [row for at, row in self._waiting if all_of_them or now - at >= _HOLD_S]
        self._waiting = self._waiting[len(ready) :]
        for rooms in self._rooms.values():
            for room in rooms.values():
                self._fill(room, now)
                if room.merged is not None and (all_of_them or (room.left >= 1 and len(ready) < WAITING)):
                    room.left -= 1
                    ready.append(room.merged)
                    room.merged = None
        self._taken = len(ready)
        return ready

    def written(self) -> None:
        """What was taken has been written."""
        self._taken = 0

    def give_back(self, rows: list[Row], now: float) -> None:
        """They could not be written: they wait, before what came meanwhile."""
        self._waiting = [(now - _HOLD_S, row) for row in rows] + self._waiting
        self._taken = 0

    def _fill(self, room: _Room, now: float) -> None:
        room.left = min(self._burst, room.left + (now - room.at) / self._period_s)
        room.at = now

    def _rooms_of(self, account: str, now: float) -> dict[object, _Room] | None:
        """None: too many accounts were here lately."""
        rooms = self._rooms.get(account)
        if rooms is None:
            if len(self._rooms) >= ACCOUNTS:
                self._forget(now)
            if len(self._rooms) < ACCOUNTS:
                rooms = self._rooms[account] = {}
        return rooms

    def _forget(self, now: float) -> None:
        """Accounts that may write as much as a new one."""
        for account, rooms in list(self._rooms.items()):
            for room in rooms.values():
                self._fill(room, now)
            if all(room.merged is None and room.left >= self._burst for room in rooms.values()):
                del self._rooms[account]


def sender(by: str | None, claim: object) -> tuple[str, str]:
    """Who to show, and whose quota it is."""
    name = shown(claim.rstrip(UNKNOWN), _NAME) if isinstance(claim, str) else ""  # a motor owner shows it marked
    if by == ROBOT:
        return f"{ROBOT}/{name}" if name else ROBOT, ROBOT
    if by is None or by == NO_ACCOUNT:
        return f"{name}{UNKNOWN}", UNKNOWN
    return by, by.partition("/")[0]
