"""The emergency stops that pages have sent: repeated until they are confirmed, and shown to pages. Pure.

The robot keeps the stop; see docs/emergency-stop.md.
"""

import logging
from collections.abc import Callable, Iterable

from pebble.contract.identity import parse_topic
from pebble.contract.payloads import EstopState
from pebble.extensions.operator.client.estop import COLLECT_S, Progress, RobotStop, StopSender
from pebble.extensions.operator.client.robot_estop import RobotEstop
from pebble.extensions.operator.client.robot_view import RobotView
from pebble.extensions.page import messages as m
from pebble.transports import Message

log = logging.getLogger(__name__)

MAX_STOPS = 2000  # that are repeated and confirmed at once: one of each robot
_SHOWN_S = 60.0  # so long pages see how a finished stop ended


class Stops:
    """The stops of a server. Publish what its methods return, and pass robots' messages to ``receive``."""

    def __init__(self, again: Callable[[], bool] = lambda: True) -> None:
        """Make an empty table. ``again()`` returns False while sent messages still wait, so that none is repeated."""
        self._again, self._repeats = again, True
        self.changed: set[str] = set()  # robots whose view may be another one now
        self._senders: dict[str, tuple[StopSender, float]] = {}  # by name, the newest last
        self._over: set[str] = set()  # those that send nothing more: to ask a thousand robots at each heartbeat is slow
        self._users: dict[str, str | None] = {}  # who has pressed each of them; None: several people, one after another
        self._refs: dict[str, str] = {}  # for which robot; "": all
        self._names: dict[str, str] = {}  # the stop of each robot, or of all
        self._crowded_at = float("-inf")  # when one was ended for lack of room
        self._shown: dict[str, tuple[str, str]] = {}  # by robot: progress and words, as pages see them

    def press(
        self,
        ref: str,
        name: str,
        *,
        by: str,
        why: str,
        now: float,
        known: Iterable[RobotView],
        user: str = "",
    ) -> list[Message]:
        """Stop one robot, or all if ``ref`` is "", in place of an earlier stop of the same robots.

        ``known`` are the robots from which messages were received.
        """
        if name in self._senders:
            return []
        robots = [robot for robot in known if ref in ("", robot.base)]
        named, bases = [ref] if ref else None, [robot.base for robot in robots]
        sender = StopSender(name, by=by, why=why, now=now, robots=named, known=bases, own_only=True)
        self._users[name] = user if self._replaced(ref, user, now) else None
        self._senders[name], self._refs[name], self._names[ref] = (sender, now), ref, name
        for robot in robots:
            for message in robot.remembered.values():
                sender.receive(message, now)
        self.changed |= set(sender.robots)
        return self.tick(now)

    def end(self, name: str) -> None:
        """Stop repeating this stop."""
        if name in self._senders:
            sender = self._senders[name][0]
            sender.end()
            self.changed |= set(sender.robots)

    def robots_of(self, name: str) -> tuple[list[str], list[str]]:
        """Return two lists: the robots that have confirmed this stop or have no motors, and the others."""
        robots = self._senders[name][0].robots if name in self._senders else {}
        done = {ref: stop.progress in (Progress.CONFIRMED, Progress.SPARED) for ref, stop in robots.items()}
        return [ref for ref in done if done[ref]], [ref for ref in done if not done[ref]]

    def user(self, name: str) -> str | None:
        """Return the user of this stop; None if it is unknown here, or has several users."""
        return self._users.get(name)

    def names(self, ref: str) -> bool:
        """True if there is a stop of this robot alone."""
        return ref in self._names

    def sends_to(self, ref: str) -> bool:
        """True if any stop is sent to this robot and awaits its answer, be it a stop of all."""
        return any(ref in sender.robots for sender, _ in self._senders.values())

    def holds(self, ref: str) -> bool:
        """True if a stop is being repeated to a robot that cannot latch it: a drive command would end it."""
        stop = self._newest(ref)[1]
        return stop is not None and stop.sending and not stop.estop.available

    @property
    def collecting(self) -> bool:
        """True if a stop of all is still sent to newly heard robots."""
        return "" in self._names and self._senders[self._names[""]][0].collecting

    def omitted(self, now: float) -> bool:
        """True if there was no room to await the confirmation of some stopped robots."""
        return now - self._crowded_at < _SHOWN_S or any(sender.omitted for sender, _ in self._senders.values())

    def receive(self, message: Message, now: float) -> list[Message]:
        """Handle a robot's message; return the messages to publish to it now."""
        address = parse_topic(message.topic)
        if address is None:
            return []
        ref, messages = address.identity.base, []
        for name in [self._names[key] for key in (ref, "") if key in self._names]:
            sender, began = self._senders[name]
            if name not in self._over or now - began < COLLECT_S:
                sender.receive(message, now)
                messages += sender.tick_robot(ref, now, again=self._repeats)
                self._note_progress(sender, ref)
        return messages

    def tick(self, now: float) -> list[Message]:
        """Return the messages to publish now; call it every 50 ms."""
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
        """Return the emergency stop of one component in the form for pages."""
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
            owners=tuple(_owner(owner, state) for owner, state in estop.states.items()),
            sending=sending,
            sending_text=text,
            stop=name,
        )

    def _note_progress(self, sender: StopSender, ref: str) -> None:
        if ref in sender.robots and self._shown.get(ref) != _progress(sender.robots[ref]):
            self.changed.add(ref)

    def _replaced(self, ref: str, user: str, now: float) -> bool:
        """Remove the earlier stop of the same robots, and others if there are too many.

        True if a new stop belongs to this user alone: the removed stop was another user's only if it was over.
        """
        is_own = True
        if (older := self._names.get(ref)) is not None:
            is_own = older in self._over or self._users[older] == user
            self._remove(older)
        while len(self._senders) >= MAX_STOPS:
            name = min(self._senders, key=self._worth)
            if name not in self._over:
                self._crowded_at = now
                log.warning("more than %d stops at once: that of %s is not confirmed", MAX_STOPS, self._refs[name])
            self._remove(name)
        return is_own

    def _worth(self, name: str) -> tuple[bool, bool, bool]:
        """Return a sort key for removal: stops that are over first, then of robots never heard, then of one robot."""
        robots = self._senders[name][0].robots.values()
        heard = not self._refs[name] or any(robot.live or robot.estop.has_capabilities for robot in robots)
        return name not in self._over, heard, not self._refs[name]

    def _remove(self, name: str) -> None:
        sender, _ = self._senders.pop(name)
        sender.end()
        self.changed |= set(sender.robots)
        self._over.discard(name)
        del self._users[name], self._names[self._refs.pop(name)]

    def _newest(self, ref: str) -> tuple[str, RobotStop | None]:
        for name, (sender, _) in reversed(self._senders.items()):
            if ref in sender.robots:
                return name, sender.robots[ref]
        return "", None


def _progress(stop: RobotStop) -> tuple[str, str]:
    progress = stop.progress
    if progress is Progress.CONFIRMED and not stop.saved:
        return progress.value, "stopped, but not saved: after a power cut it is free"
    return progress.value, stop.why


def _owner(owner: str, state: EstopState) -> m.OwnerState:
    fields = {name: getattr(state, name) for name in m.OwnerState.__struct_fields__ if name != "owner"}
    return m.OwnerState(owner=owner, **fields)
