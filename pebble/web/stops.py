"""The emergency stops that pages have asked for, sent until they are confirmed, and what pages see of them. Pure.

The robot remembers the stop; see docs/emergency-stop.md.
"""

from collections.abc import Callable, Collection, Iterable

from pebble.client.estop import COLLECT_S, Progress, RobotStop, StopSender
from pebble.client.rank import Rank
from pebble.client.robot_view import RobotView
from pebble.contract.identity import parse_topic
from pebble.runtime.robot_estop import RobotEstop
from pebble.transports import Message
from pebble.web import messages as m
from pebble.web.pace import STOP_WAITS_S, Pace

MAX_STOPS = 512  # that are being sent at once: more than one of each robot that is known from before
MAX_SAME = 64  # of them for the same robot, or for all: the newest are sent,
MAX_EACH = 4  # and of those by one user
_SHOWN_S = 60.0  # so long pages see how a finished stop ended

_SENDING = {
    Progress.WAITING: "sent",
    Progress.CONFIRMED: "confirmed",
    Progress.OLD: "old",
    Progress.SPARED: "spared",
    Progress.NOT_CONFIRMED: "not confirmed",
}


class Stops:
    """Publish what its methods return, and pass every message of the robots to ``receive``."""

    def __init__(self, again: Callable[[], bool] = lambda: True) -> None:
        """``again``: whether what was sent may be sent again; not while that still waits, behind which it would be."""
        self._again, self._repeats = again, True
        self.changed: set[str] = set()  # robots whose view may be another one now
        self._senders: dict[str, tuple[StopSender, float]] = {}  # by name, the newest last
        self._over: set[str] = set()  # those that send nothing more: to ask a thousand robots at each heartbeat is slow
        self._users: dict[str, str] = {}  # who has pressed each of them
        self._refs: dict[str, str] = {}  # for which robot; "": all
        self._shown: dict[str, tuple[str, str]] = {}  # by robot: progress and words, as pages see them
        self._paces: dict[str, Pace] = {}  # by person

    def press(
        self,
        ref: str,
        name: str,
        *,
        by: str,
        why: str,
        now: float,
        known: Iterable[RobotView],
        before: Collection[str] = (),
        user: str = "",
    ) -> list[Message]:
        """Stop one robot, or all if ``ref`` is "".

        ``known`` are the robots from which messages were received; those known from ``before`` are stopped with
        all, too.
        """
        if name in self._senders:
            return []
        self._make_room(ref, user)
        sender = StopSender(name, by=by, why=why, now=now, robots=[ref] if ref else None, known=before, own_only=True)
        self._senders[name], self._users[name], self._refs[name] = (sender, now), user, ref
        for robot in known:
            if not ref or robot.base == ref:
                for message in robot.remembered.values():
                    sender.receive(message, now)
        self.changed |= set(sender.robots)
        return self.tick(now)

    def waits_s(self, user: str, now: float) -> float:
        """How long a stop of this person waits that comes without a control socket, as it would on one."""
        return min(self._paces.setdefault(user, Pace(now)).take(1, now), STOP_WAITS_S)

    def end(self, name: str) -> None:
        """Send this stop no more."""
        if name in self._senders:
            sender = self._senders[name][0]
            sender.end()
            self.changed |= set(sender.robots)

    def user(self, name: str) -> str | None:
        """Who has pressed this stop; None if it is not known here."""
        return self._users.get(name)

    def receive(self, message: Message, now: float) -> list[Message]:
        """Take a message of a robot; returns what to publish to this robot now."""
        address = parse_topic(message.topic)
        if address is None:
            return []
        ref, messages = address.identity.base, []
        for name, (sender, began) in self._senders.items():
            if self._refs[name] in ("", ref) and (name not in self._over or now - began < COLLECT_S):
                sender.receive(message, now)
                messages += sender.tick_robot(ref, now, again=self._repeats)
                self._note_progress(sender, ref)
        return messages

    def tick(self, now: float) -> list[Message]:
        """What to publish now; to be called every 50 ms."""
        messages, self._repeats = [], self._again()
        for name, (sender, began) in list(self._senders.items()):
            if name not in self._over:
                messages += sender.tick(now, again=self._repeats)
                if sender.finished:  # else what has come of it was noted with the robot's message
                    self._over.add(name)
                    for ref in sender.robots:
                        self._note_progress(sender, ref)
            if name in self._over and now - began > _SHOWN_S:
                self._remove(name)
        return messages

    def view(self, estop: RobotEstop) -> m.EstopView:
        """What pages see of the emergency stop of one component."""
        name, stop = self._newest(estop.base)
        sending, text = ("", "") if stop is None else _progress(stop)
        self._shown[estop.base] = sending, text
        by = estop.stopped_by
        return m.EstopView(
            available=estop.available,
            latched=bool(estop.latched),
            by="" if by is None else by.by,
            why="" if by is None else by.why,
            since=0 if by is None else by.since,
            owners=tuple(_owner(owner, estop) for owner in estop.states),
            sending=sending,
            sending_text=text,
            stop=name,
        )

    def _note_progress(self, sender: StopSender, ref: str) -> None:
        if ref in sender.robots and self._shown.get(ref) != _progress(sender.robots[ref]):
            self.changed.add(ref)

    def _make_room(self, ref: str, user: str) -> None:
        same = [name for name, one in self._refs.items() if one == ref]
        same.sort(key=lambda name: not self._senders[name][0].finished)  # stable: else the oldest first
        own = [name for name in same if self._users[name] == user]
        for name in {*same[: max(0, len(same) - MAX_SAME + 1)], *own[: max(0, len(own) - MAX_EACH + 1)]}:
            self._remove(name)
        if len(self._senders) >= MAX_STOPS:
            newest = {one: name for name, one in self._refs.items() if not self._senders[name][0].finished}
            self._remove(min(self._senders, key=lambda name: self._worth(name, newest.get(self._refs[name]))))

    def _worth(self, name: str, newest: str | None) -> tuple[bool, bool, bool, Rank]:
        """What is confirmed goes first, then what a newer stop stops as well, then robots that may be invented."""
        sender, ref = self._senders[name][0], self._refs[name]
        rank = sender.robots[ref].rank if ref else Rank()
        return not sender.finished, name == newest, not ref, rank

    def _remove(self, name: str) -> None:
        sender, _ = self._senders.pop(name)
        sender.end()
        self.changed |= set(sender.robots)
        self._over.discard(name)
        del self._users[name], self._refs[name]

    def _newest(self, ref: str) -> tuple[str, RobotStop | None]:
        for name, (sender, _) in reversed(self._senders.items()):
            if ref in sender.robots:
                return name, sender.robots[ref]
        return "", None


def _progress(stop: RobotStop) -> tuple[str, str]:
    progress = stop.progress
    if progress is Progress.CONFIRMED and not stop.saved:
        return _SENDING[progress], "stopped, but not saved: after a power cut it is free"
    return _SENDING[progress], stop.why


def _owner(owner: str, estop: RobotEstop) -> m.OwnerState:
    state = estop.states[owner]
    return m.OwnerState(
        owner=owner,
        latched=state.latched,
        boot=state.boot,
        count=state.count,
        by=state.by,
        why=state.why,
        since=state.since,
        persisted=state.persisted,
        reset_refused=state.reset_refused,
    )
