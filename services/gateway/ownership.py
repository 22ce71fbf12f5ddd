"""Decides which of several gateways carries a robot, so that no two do so at once. Pure.

Gateways agree by their heartbeats at the broker, which is the side that must not receive anything twice. Each of them
counts for the robots that it lists; of those that are fresh the one with the highest score carries a robot. A gateway
counts itself by what the *broker* has sent back of its own heartbeats, on the same connection as those of others. So
it knows that it has received what the others had published until then, and that they receive what it publishes.

Who begins to carry a robot has waited TAKING_S: by then another one that did so has either received that this one
counts, or has had no heartbeat of its own back for FRESH_S, and has stopped. docs/decisions/0032 has the table.
"""

import threading
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from hashlib import blake2b

FRESH_S = 1.0  # so old a heartbeat counts
TAKING_S = 1.25  # more than FRESH_S and one period of heartbeats
#: After the broker has published the will of the one before: more than a period of heartbeats, because it may be that
#: of an earlier connection.
WILL_S = 0.5
ALONE_S = 3.0  # after so long at the broker another gateway would have been heard
MAX_GATEWAYS = 16  # that are known beside this one
MAX_ROBOTS = 1000  # of one gateway

_NEVER = float("-inf")


@dataclass(frozen=True, slots=True)
class _Known:
    """The newest heartbeat of a gateway. Of this one ``at`` is when it was sent, of others when it was received."""

    at: float
    robots: frozenset[str]


_NONE = _Known(_NEVER, frozenset())


class Ownership:
    """The robots that this gateway carries, and from when. Thread-safe; times are those of one monotonic clock."""

    def __init__(self, me: str) -> None:
        self.me = me
        self._lock = threading.RLock()
        self._mine = _NONE
        self._others: dict[str, _Known] = {}
        self._connected_at: float | None = None
        self._wills: dict[str, float] = {}
        self._will_at = _NEVER  # the newest
        #: By robot: who is to carry it, and since when this has not changed.
        self._owners: dict[str, tuple[str, float]] = {}
        self._due: dict[str, float] = {}  # from when this gateway carries a robot
        self._scores: dict[tuple[str, str], bytes] = {}

    # -- what happens

    def connected(self, now: float) -> None:
        """There is a connection to the broker (again): nothing is known yet."""
        with self._lock:
            self.lost()
            self._connected_at = now

    def lost(self) -> None:
        """The connection to the broker was lost."""
        with self._lock:
            self._connected_at = None
            self._mine = _NONE
            for known in (self._others, self._wills, self._owners, self._due):
                known.clear()
            self._will_at = _NEVER

    def came_back(self, sent_at: float, robots: Collection[str], now: float) -> None:
        """The broker has sent back a heartbeat of this gateway."""
        with self._lock:
            self.judge(now)  # what was too late for it is over before it counts again
            if self._connected_at is not None and sent_at >= max(self._connected_at, self._mine.at):
                self._mine = _Known(sent_at, frozenset(robots))
            self.judge(now)

    def received(self, gateway: str, robots: Collection[str], now: float) -> None:
        """The broker has sent a heartbeat of another gateway; a retained one counts as fresh."""
        with self._lock:
            if gateway not in self._others and len(self._others) >= MAX_GATEWAYS:
                oldest = min(self._others, key=lambda one: self._others[one].at)
                if now - self._others[oldest].at <= FRESH_S:
                    return
                del self._others[oldest]
            self._wills.pop(gateway, None)
            self._others[gateway] = _Known(now, frozenset(robots))
            self.judge(now)

    def left(self, gateway: str, now: float) -> None:
        """The broker has published the will of another gateway, or it has left in order."""
        with self._lock:
            if self._others.pop(gateway, None) is not None:
                if len(self._wills) >= MAX_GATEWAYS:
                    del self._wills[next(iter(self._wills))]
                self._wills[gateway] = self._will_at = now
            self.judge(now)

    def judge(self, now: float) -> None:
        """Find out who is to carry each robot now; at each event, and a few times in a second."""
        with self._lock:
            if now - self._mine.at > FRESH_S:
                self._due.clear()
                self._owners.clear()
                return
            fresh = {name: one.robots for name, one in self._others.items() if now - one.at <= FRESH_S}
            fresh[self.me] = self._mine.robots
            for robot in self._mine.robots:
                owner = max((self._score(name, robot), name) for name, robots in fresh.items() if robot in robots)[1]
                before, since = self._owners.get(robot, ("", now))
                if owner != before:
                    self._owners[robot] = owner, now
                if owner != self.me:
                    self._due.pop(robot, None)
                elif robot not in self._due:
                    self._due[robot] = now + self._wait(before, now - since, now)
            for robot in self._owners.keys() - self._mine.robots:
                del self._owners[robot]
                self._due.pop(robot, None)

    # -- what follows from it

    def since(self, robot: str, now: float) -> float | None:
        """Since when this gateway carries ``robot`` without a break; None: it does not. Hot: asked for each message."""
        if now - self._mine.at > FRESH_S:
            self.judge(now)
            return None
        due = self._due.get(robot)
        return due if due is not None and due <= now else None

    def held(self, now: float) -> dict[str, float]:
        """The robots that it carries at this moment, and since when."""
        with self._lock:
            each = {robot: self.since(robot, now) for robot in list(self._due)}
        return {robot: since for robot, since in each.items() if since is not None}

    def next_due(self, now: float) -> float:
        """When the next robot is due that it does not carry yet; infinity: none is."""
        with self._lock:
            return min((due for due in self._due.values() if due > now), default=float("inf"))

    @property
    def others(self) -> Mapping[str, frozenset[str]]:
        """The other gateways that are known, fresh or not, and what each receives."""
        with self._lock:
            return {name: one.robots for name, one in self._others.items()}

    # -- with the lock held

    def _wait(self, before: str, stood_s: float, now: float) -> float:
        """How long to wait until the one before has stopped for certain."""
        if not self._others and self._connected_at is not None and now - self._connected_at >= ALONE_S:
            return max(0.0, self._will_at + WILL_S - now)
        will_at = self._wills.get(before)
        if will_at is not None and stood_s >= TAKING_S:  # all gateways knew that it was that one
            return max(0.0, will_at + WILL_S - now)
        return TAKING_S

    def _score(self, gateway: str, robot: str) -> bytes:
        score = self._scores.get((gateway, robot))
        if score is None:
            if len(self._scores) >= MAX_GATEWAYS * MAX_ROBOTS:
                self._scores.clear()
            score = blake2b(f"{gateway}/{robot}".encode(), digest_size=8).digest()
            self._scores[gateway, robot] = score
        return score
