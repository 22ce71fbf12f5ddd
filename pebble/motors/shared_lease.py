"""The leases of a robot's motor owners. Of several, the first owner by name grants, and the others follow. Pure.

A *turn* is a grant with its number, which the others repeat. Times are milliseconds of the machine's clock.
No holder is taken for silent because of a flood, an outage or a stalled broker.
"""

import sys
from typing import Any

from pebble.contract.payloads import ControlTurn
from pebble.motion.lease import Lease

ENDS_AFTER_MS = 30_000  # so long control lasts without a message of its holder, whatever else happens
_IDLE_MS, _OTHERS_MS = 5000, 2000  # as in Lease
FOLLOWS_MS = 1500  # so long after it was sent a turn is followed; it is repeated every 500
SETTLES_MS = FOLLOWS_MS + 100


class SharedLease(Lease):
    """The lease of an only owner, and the base of two that refuse motion while owners may disagree who has control.

    Silence of the holder counts only in periods for which the bridge vouches, because it has passed on every message
    that came in them. After ``ENDS_AFTER_MS`` it counts in any case.
    """

    vouched: tuple[int, int] | None = None  # begin and end; None: there is no bridge, and all time counts
    _received_all_since = 0  # before it messages may have been lost in this process
    until = sys.maxsize  # when everything stops, unless another turn is received before

    def __init__(self, peers: frozenset[str], now: int, *lease: Any) -> None:
        """Store the peers, which are the other motor owners; ``lease``: the other arguments of Lease."""
        super().__init__(now, *lease)
        self.peers = peers

    def vouch(self, begin: int, end: int, now: int) -> None:
        """Note the period for which the bridge vouches. Ignore one from the future: it is of another clock."""
        if self.vouched is not None and begin <= end <= now:
            self.vouched = max(begin, self._received_all_since), end

    def doubt(self, now: int) -> None:
        """Note that messages which the bridge has forwarded until now may be lost in this process."""
        self._received_all_since = now

    def tick(self, now: int) -> None:
        """End control whose time is over. This repeats Lease.tick, which is kept in one piece to save memory on boards.

        The silent time is computed in each call, because the vouched time may shrink.
        """
        if self.others and now - self._received >= _OTHERS_MS:
            self.others, self.changed = False, True
        if self.asker and now - self._asked >= self._wait:
            self.asker, self.changed = (), True
        self._held = self.key != "" and self._quiet_ms(self._held_from, now) < _IDLE_MS
        # Not renewed for too long, or another client asks and the holder is idle:
        if self.key and (self._quiet_ms(self._since, now) >= self._limit_ms or (self.asker and not self._held)):
            self._end(now)

    def _quiet_ms(self, since: int, now: int) -> int:
        """Return for how long the holder has been silent, counting only vouched time."""
        quiet = now - since
        if self.vouched is None or quiet >= ENDS_AFTER_MS:
            return quiet
        begin, end = self.vouched
        return end - max(since, begin)

    def refuses(self, moves: bool, script: bool, key: str, by: str, now: int) -> bool:
        refused = super().refuses(moves, script, key, by, now)
        return refused or (moves and self.waits(now))

    def waits(self, _now: int) -> bool:
        """True if no client may move anything now."""
        return False

    def receive(self, owner: str, turn: ControlTurn, now: int) -> None:
        """Note the turn that a peer has sent."""

    def shown(self, _barred: int, _now: int) -> ControlTurn | None:
        """Return the turn to send to the peers; None if there is none to send."""
        return None


class FirstLease(SharedLease):
    """The lease of the first owner: after its start and each handover it waits until the others follow."""

    def __init__(self, boot: str, peers: frozenset[str], now: int, *lease: Any) -> None:
        super().__init__(peers, now, *lease)
        self._boot, self._turn = boot, 0  # the number of the present turn
        self._missing, self._turned_at = set(peers), now  # peers that do not follow it yet, and when it began

    def take(self, client: tuple[str, ...], ms: int, now: int) -> None:
        super().take(client, ms, now)
        self._turn += 1
        self._missing, self._turned_at = set(self.peers), now

    def waits(self, now: int) -> bool:
        return bool(self._missing) and now - self._turned_at < SETTLES_MS

    def receive(self, owner: str, turn: ControlTurn, _now: int) -> None:
        if (turn.boot, turn.turn) == (self._boot, self._turn):
            self._missing.discard(owner)

    def shown(self, barred: int, now: int) -> ControlTurn:
        account, name, by, device = self.holder or ("", "", "", "")
        _, asks_id, asks, _ = self.asker or ("", "", "", "")
        return ControlTurn(
            boot=self._boot, turn=self._turn, t=now, key=self.key, account=account, id=name, by=by, device=device,
            asks=asks, asks_id=asks_id, others=self.others, barred=barred,
        )  # fmt: skip


class FollowingLease(SharedLease):
    """The lease of any other motor owner: it follows the lease of the first, and grants and ends nothing itself."""

    until = 0

    def __init__(self, peers: frozenset[str], now: int, *lease: Any) -> None:
        super().__init__(peers, now, *lease)
        self._followed: ControlTurn | None = None

    def waits(self, now: int) -> bool:
        return now >= self.until

    def receive(self, _owner: str, turn: ControlTurn, now: int) -> None:
        """Follow the first owner's newest turn. Ignore a turn from the future: its time is of another clock."""
        earlier = self._followed
        if turn.t > now or (earlier is not None and turn.t < earlier.t):
            return
        self._followed, self.until = turn, turn.t + FOLLOWS_MS
        if earlier is None or (turn.boot, turn.turn) != (earlier.boot, earlier.turn):
            holder = (turn.account, turn.id, turn.by, turn.device) if turn.key else ()  # a client, see Lease
            self.take(holder, 0, now)  # 0: the lease makes no key of its own
            self.key = turn.key
        asker = ("", turn.asks_id, turn.asks, "") if turn.asks_id else ()  # a turn lacks the asker's account and device
        self.changed = self.changed or (asker, turn.others) != (self.asker, self.others)
        self.asker, self.others = asker, turn.others  # others: as at the first owner, see Lease

    def shown(self, _barred: int, _now: int) -> ControlTurn | None:
        turn = self._followed
        return None if turn is None else ControlTurn(boot=turn.boot, turn=turn.turn)

    def hold(self, client: tuple[str, ...], ms: int, urgent: bool, now: int) -> None:
        """Do nothing: the first owner answers."""

    def release(self, client: tuple[str, ...], now: int) -> None:
        """Do nothing: the first owner answers."""

    def tick(self, now: int) -> None:
        """Do nothing: the first owner ends control that is over."""


def lease_of(owner: str, owners: tuple[str, ...], boot: str, *lease: Any) -> SharedLease:
    """Return the lease of ``owner``, one of the robot's ``owners``; ``lease``: the arguments of Lease."""
    others, first = frozenset(owners) - {owner}, min(owners, default=owner)
    if not others:
        return SharedLease(others, *lease)
    return FirstLease(boot, others, *lease) if owner == first else FollowingLease(frozenset({first}), *lease)
