"""What must hold of stops beyond a bridge, said of what it had, what it passed on and what the motor owners published.

* A stop that the bridge has passed on latches each owner that runs and is reached, unless a reset that was sent later
  ended it, also if a copy of it comes after the reset. Excused: what a killed bridge forgets.
* A stop with a name passes to all owners as often as it came, and one without a name once, except around a loss of the
  connection of stops, where equal bytes cannot be told apart.
* An owner that has shown that a stop was reset gets no copy of it. Excused: what a killed bridge forgets. To an owner
  that has forgotten a stop, a copy that passed before its reset was known is a new stop.
* What is repeated is the newest stop that its owner has not shown, names its owner, and ends when that has withdrawn
  its emergency stop; in the end nothing is repeated, and a new stop stops every owner.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from msgspec import UNSET

from pebble.contract import ESTOP, ESTOP_RESET, ESTOP_STATE, codec
from pebble.contract.payloads import EstopState
from pebble.transports import Message
from tests.robot.lockstep.drivers import BASE
from tests.robot.lockstep.network import Scheduler
from tests.robot.lockstep.owner import Bridge, Owner

_LATCHES_S = 2.5  # a state and a repetition each may travel for 0.7 s
_REPEAT_S = 0.5
_STOP, _RESET = ESTOP.topic(BASE), ESTOP_RESET.topic(BASE)


class StopRules:
    """The rules of one bridge and its owners, by name."""

    def __init__(self, scheduler: Scheduler, bridge: Bridge, owners: Mapping[str, Owner]) -> None:
        self._scheduler, self._bridge, self._owners = scheduler, bridge, owners
        self._topics = {ESTOP_STATE.topic(BASE, owner=name): name for name in owners}
        self._nameless = 0  # that were pressed
        self._named: set[str] = set()  # names of the others
        self._invented: set[str] = set()  # names that the bridge has given them
        self.doubtful = False  # the connection of stops was lost
        self._published: dict[str, EstopState] = {}  # by owner, the newest state
        self._resets: dict[tuple[str, int], float] = {}  # by boot and count: when the newest was sent
        self._reset_sent = dict.fromkeys(owners, 0.0)  # when the newest reset was sent that an owner has obeyed
        self._reached_from = dict.fromkeys(owners, 0.0)
        self.repeated_at = 0.0
        self._stopped: dict[str, float] = {}  # by name: when it passed first, in any life of the bridge
        self.begin()

    def begin(self) -> None:
        """A new life of the bridge, which remembers nothing."""
        self._came: Counter[str] = Counter()  # by name
        self._came_at: dict[str, float] = {}  # by name, the newest copy
        self._came_first: dict[str, float] = {}  # by name: when the first copy came, which may not have passed
        self._passed: Counter[str] = Counter()  # by name: to all owners
        self._first: dict[str, float] = {}  # by name: when it passed first
        self._seen: dict[str, EstopState] = {}  # by owner: what the bridge knows
        self._shown: set[tuple[str, str]] = set()  # (owner, name)
        self._over: set[tuple[str, str]] = set()  # the same, and it was reset since
        self._withdrawn: dict[str, float] = {}

    # -- what happens

    def sent(self, message: Message) -> None:
        """A person sends something, on either side."""
        if message.topic == _STOP and not message.retain:
            stop = codec.decode(ESTOP, message.payload).stop
            self._nameless += stop is UNSET
            self._named.add(str(stop))
        elif message.topic == _RESET:
            reset = codec.decode(ESTOP_RESET, message.payload)
            self._resets[reset.boot, reset.count] = self._scheduler.now

    def comes(self, message: Message) -> None:
        """The bridge has something of the operators'."""
        if message.topic == _STOP and message.payload.strip() and not message.retain:
            stop = codec.decode(ESTOP, message.payload).stop
            self._came_at[str(stop)] = self._scheduler.now
            if stop is not UNSET:
                self._came[str(stop)] += 1
                self._came_first.setdefault(str(stop), self._scheduler.now)

    def learns(self, message: Message) -> None:
        """The bridge has something of the robot's."""
        owner = self._topics.get(message.topic)
        if owner is None:
            return
        if not message.payload:
            self._withdrawn.setdefault(owner, self._scheduler.now)
            return
        self._withdrawn.pop(owner, None)
        state, before = codec.decode(ESTOP_STATE, message.payload), self._seen.get(owner)
        self._seen[owner] = state
        same = before is not None and before.boot == state.boot
        if before is not None and same and not state.latched and (before.latched or state.count > before.count):
            self._over |= {shown for shown in self._shown if shown[0] == owner and shown[1] in self._first}
        self._shown |= {(owner, name) for name in state.recent}

    def shows(self, owner: str, payload: bytes) -> None:
        """An owner publishes its state."""
        if not payload:
            return
        state, before = codec.decode(ESTOP_STATE, payload), self._published.get(owner)
        self._published[owner] = state
        if before is not None and before.latched and not state.latched:
            sent = [at for (boot, count), at in self._resets.items() if boot == before.boot and count >= before.count]
            self._reset_sent[owner] = max([self._reset_sent[owner], *sent])

    def passes(self, message: Message) -> None:
        """The bridge publishes something to the robot."""
        if message.topic != _STOP or not message.payload.strip():
            return
        stop, now = codec.decode(ESTOP, message.payload), self._scheduler.now
        name, owners = str(stop.stop), list(self._owners) if stop.owner is UNSET else [str(stop.owner)]
        copied = now == self._came_at.get(name)
        for owner in owners:
            self._check((owner, name) not in self._over, "an owner gets a copy of a stop that it has shown to be reset")
        if stop.owner is not UNSET:
            if not copied:
                self.repeated_at = now
                self._repeats(owners[0], name)
            return
        forgetful = (owner for owner in owners if owner in self._seen and name not in self._seen[owner].recent)
        self._shown -= {(owner, name) for owner in forgetful}
        self._passed[name] += 1
        self._first.setdefault(name, now)
        self._stopped.setdefault(name, now)
        if name in self._came:
            self._check(self._passed[name] <= self._came[name], "a stop passes to all owners more often than it came")
            return
        self._check(self._passed[name] == 1, "a stop without a name is repeated to all owners")
        self._invented.add(name)
        most = self._nameless + 100 * self.doubtful
        self._check(len(self._invented) <= most, "a stop without a name passes twice")

    def _repeats(self, owner: str, name: str) -> None:
        since = self._withdrawn.get(owner, self._scheduler.now)
        self._check(
            self._scheduler.now - since < _REPEAT_S, "a stop is repeated to an owner that has withdrawn its own"
        )
        self._first.setdefault(name, self._scheduler.now)  # if nothing passed: it had no connection to the robot
        self._stopped.setdefault(name, self._scheduler.now)
        firsts = self._first | self._came_first
        shown = (first for other, first in firsts.items() if (owner, other) in self._shown)
        newest = max(firsts[name], *shown, 0.0)
        # A nameless one of the robot's own side is not shown under the name by which it is repeated.
        missed = any(first > newest for other, first in firsts.items() if other in self._named | self._invented)
        self._check(not missed, "an older stop is repeated in place of a newer one")

    # -- what must hold at any time

    def check(self) -> None:
        now, bridged = self._scheduler.now, self._bridge.reaches_owners
        for name, owner in self._owners.items():
            reached = owner.connection is not None and owner.connection._present and not owner.frozen
            if not (bridged and owner.alive and reached):
                self._reached_from[name] = now
            due = [at for at in (self._stopped[stop] for stop in self._first) if at > self._reset_sent[name]]
            state = self._published.get(name)
            if due and state is not None and not state.latched:
                late = now - max(max(due), self._reached_from[name]) > _LATCHES_S
                self._check(not late, "an owner is free after a stop that was passed on")

    @property
    def all_latched(self) -> bool:
        return all(state.latched for state in self._published.values())

    def _check(self, holds: bool, rule: str) -> None:
        self._scheduler.check(holds, rule)
